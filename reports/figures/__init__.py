"""Figures as papers have them, from finished runs."""
