"""OccNeRF: a human NeRF on features of the body's surface that borrows from neighbours what an occluder hides."""
