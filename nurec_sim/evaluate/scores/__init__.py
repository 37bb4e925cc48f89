"""Scores of images, depth and LiDAR sweeps."""
