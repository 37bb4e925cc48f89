"""Weights of the network: files, downloads, and what a file fits."""
