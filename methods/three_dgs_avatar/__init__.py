"""3DGS-Avatar: Gaussians moved by a hash-grid deformation and a learned skinning field, coloured by a network."""
