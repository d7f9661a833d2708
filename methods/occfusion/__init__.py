"""OccFusion: Gaussians in the big pose, complete silhouettes, score distillation on alpha, in-context inpainting."""
