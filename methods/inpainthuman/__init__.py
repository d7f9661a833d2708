"""InpaintHuman: multi-scale UV feature maps that drive 3D Gaussians on a SMPL body."""
