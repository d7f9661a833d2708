"""Sets of Gaussians that grow and shrink while they are fitted: Adam, density control, the guarded loop."""
