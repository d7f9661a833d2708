"""Methods: one folder per system, each with a card and its code."""
