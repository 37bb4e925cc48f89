"""True sensors in a town: cameras, LiDARs, depth, boxes."""
