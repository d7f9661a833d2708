"""The site of some runs: one offline page with tables, frames, curves and avatars that move."""
