"""GaussianAvatar (Hu et al. 2024): one opaque Gaussian a texel, decoded by one network; no mask loss."""
