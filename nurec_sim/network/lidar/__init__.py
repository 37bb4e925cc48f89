"""The network's LiDAR branch (paper section "Extension to LiDAR Reconstruction"): range maps in, Gaussians out."""
