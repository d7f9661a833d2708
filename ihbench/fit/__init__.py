"""What methods share when they fit."""
