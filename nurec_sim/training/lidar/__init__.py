"""Training of the LiDAR branch: sweeps of procedural towns, rendered from other poses."""
