"""The general report of finished runs."""
