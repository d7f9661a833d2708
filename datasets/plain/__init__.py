"""A plain folder: images, masks, cameras and poses of anybody's video."""
