"""Reconstruction methods, one file and one class each; ``plugins.load`` finds them here by themselves."""
