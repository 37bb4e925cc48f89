"""Fixtures of the tests of archives."""

import pytest

from nurec_sim.scene.interop.validate import alpasim_roads


@pytest.fixture
def few_placements(monkeypatch: pytest.MonkeyPatch) -> None:
    """Places 30 cars beside the path instead of 200: for tests of all but the map, whose verdicts take most time."""
    monkeypatch.setattr(alpasim_roads, "PLACEMENTS", 30)
