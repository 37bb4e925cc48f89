"""From projected Gaussians to images and sweeps: rays, tiles, blending, compositing."""
