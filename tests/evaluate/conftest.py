"""Fixtures of the tests of evaluation."""

import pytest

from nurec_sim.evaluate import lidar_scores


@pytest.fixture(scope="module", autouse=True)
def _one_scan_per_offset():
    """Returns beside the path are simulated at one instant instead of five, which takes half of an evaluation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lidar_scores, "SCANS", 1)
        yield
