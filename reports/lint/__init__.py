"""Finds wrong marks, arrows, units and claims in tables."""
