"""The paper's tables, its numbers as data."""
