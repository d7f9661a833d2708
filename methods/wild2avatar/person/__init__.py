"""The person of Wild2Avatar: shape, colour, the way to the canonical pose and along rays."""
