"""The three stages, and the optimisation that the first and the last share."""
