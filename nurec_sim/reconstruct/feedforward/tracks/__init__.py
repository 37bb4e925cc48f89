"""Moving Gaussians and the tracks they follow: labelled ones, and those found by motion."""
