"""From Gaussians to records with bounds on a sensor's grid, for any lens and motion."""
