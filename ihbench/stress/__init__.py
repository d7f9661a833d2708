"""The stiff and extreme cases behind `ihbench stress`: named, versioned, each with an answer known otherwise."""
