"""Views along z for tests of what is drawn into them and seen in them."""

import numpy as np

from nurec_sim import geometry

TOWARDS = np.array([[0.0, 0.0, -1.0]])
"""The normal of a surface that faces the views of these tests, which look along z."""


def looking_ahead(behind_m=0.0, width=9, height=9, focal_px=10.0):
    """A packed view (``WorkingView.packed``) from as far behind the origin, without drift."""
    pose = geometry.pose(np.eye(3), np.array([0.0, 0.0, behind_m]))
    return np.concatenate(
        [[focal_px, width / 2, height / 2, width, height], pose[:3, :3].ravel(), pose[:3, 3], np.zeros(6)]
    )
