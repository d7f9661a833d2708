"""Checking a copy of a data set, and handing out an occluded training set."""
