"""Stand-ins: procedural people filmed in a data set's own layout."""
