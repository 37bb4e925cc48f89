"""Gradients on the CPU: from images back to Gaussians, sensor poses and the sky."""
