"""Volumes: rays, intervals, density laws, compositing, a renderer that skips what is empty, and its float64 twin."""
