"""Wild2Avatar: a skinned signed distance field between an occlusion layer and a background, on a Vid2Avatar base."""
