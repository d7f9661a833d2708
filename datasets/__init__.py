"""Data sets: one module per on-disk format, each reads and writes it."""
