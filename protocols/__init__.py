"""Protocols: one TOML file each, and the occlusion rules they name."""
