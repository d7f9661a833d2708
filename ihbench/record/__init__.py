"""Runs on disk: typed records, their index, identities and results."""
