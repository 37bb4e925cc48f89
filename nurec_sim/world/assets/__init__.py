"""Meshes and textures of static objects and actors."""
