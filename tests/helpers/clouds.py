"""Clouds of points for tests."""

import numpy as np

from nurec_sim.reconstruct.lift.cloud import Cloud


def cloud_of(xyz, eye=(0.0, 0.0, 5.0), spacing=0.1):
    n = len(xyz)
    return Cloud(np.asarray(xyz, float), np.broadcast_to(np.asarray(eye, float), (n, 3)).copy(),
                 np.full(n, spacing, np.float32), np.full(n, np.nan, np.float32))  # fmt: skip
