"""The one diffusion path: backbones, personalisation, sampling, complete silhouettes."""
