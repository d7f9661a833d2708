"""Avatars as pictures that move: where the camera goes, what the body does, how frames become a file."""
