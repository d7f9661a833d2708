"""The version of the bench; it is part of every record and of a run's identity."""

__version__ = "0.2.0"
