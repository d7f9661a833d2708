"""What radiance fields share when they are fitted: targets, patches, marching, the fit step by step."""
