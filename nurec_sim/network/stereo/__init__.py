"""Classical matching between images: depth, its refinement, and motion."""
