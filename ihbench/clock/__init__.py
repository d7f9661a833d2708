"""What a run costs and how it is watched: stages and checkpoints, threads, progress, interruption."""
