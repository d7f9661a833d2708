"""The avatar: UV features, decoder, Gaussians on the posed body."""
