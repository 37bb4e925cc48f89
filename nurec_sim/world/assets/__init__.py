"""Meshes and textures of what stands and moves in a town."""
