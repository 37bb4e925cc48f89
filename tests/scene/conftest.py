"""Fixtures of the tests of archives."""

from xml.etree import ElementTree

import pytest

from nurec_sim.scene.interop.validate import alpasim_roads
from nurec_sim.scene.interop.validate.alpasim_map import AlpasimMap

_read: dict[bytes, AlpasimMap] = {}


@pytest.fixture
def quick_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that validate many archives: the map takes most of the time, so that each one is read once.

    Of 200 cars beside the path 30 are compared; ``test_scene_map.py`` compares all.
    """

    def read_once(root: ElementTree.Element) -> AlpasimMap:
        key = ElementTree.tostring(root)
        if key not in _read:
            _read[key] = AlpasimMap(root)
        return _read[key]

    monkeypatch.setattr(alpasim_roads, "AlpasimMap", read_once)
    monkeypatch.setattr(alpasim_roads, "PLACEMENTS", 30)
