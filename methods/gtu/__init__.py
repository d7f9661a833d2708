"""GTU (Guess The Unseen): skinned Gaussians, photos where somebody looked, score distillation where nobody did."""
