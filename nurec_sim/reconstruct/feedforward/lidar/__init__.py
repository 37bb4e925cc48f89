"""Predicted depth fitted to the LiDAR sweeps of a log."""
