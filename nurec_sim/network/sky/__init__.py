"""The sky: decoders, cubemaps, and what shows through between Gaussians."""
