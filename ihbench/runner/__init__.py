"""The run loop: stages, resume, several runs side by side, sweeps."""
