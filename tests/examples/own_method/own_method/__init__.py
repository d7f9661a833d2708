"""A method in a package of its own: the body mesh in one grey."""
