"""A method as somebody else might register it: the body mesh in one colour. For tests of the bench only."""
