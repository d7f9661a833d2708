"""OccGaussian (Ye, Zhang, Liao, ICMR 2025), rebuilt; its details are inferred."""
