"""Drawing: the mesh z-buffer (`zbuffer`) and the Gaussian splat renderer (`splat`)."""
