"""How right images, depth and LiDAR sweeps are."""
