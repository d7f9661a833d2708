"""Avatars as files for other people's programs: splat PLY, glTF, textures, motions."""
