"""GauHuman: articulated anisotropic Gaussians with KL-gated density control; OccGauHuman, made for occlusion."""
