// splats
