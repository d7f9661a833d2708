"""Gaussians on the body in the big pose, skinned to a frame: what GauHuman is, and what OccFusion is built on."""
