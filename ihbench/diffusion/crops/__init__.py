"""What a diffusion model is shown of a training view: person crops, part maps, masks, batches."""
