"""Fixtures of the tests of archives."""

import functools
import pickle

import pytest

from nurec_sim.scene import sidecars
from nurec_sim.scene.interop.validate import alpasim_roads, maps
from nurec_sim.scene.interop.validate.alpasim_map import AlpasimMap
from nurec_sim.scene.opendrive import reader
from nurec_sim.scene.opendrive.xml import opendrive_root

# Trees that are equal are one tree, and hash by identity.
_root, _map = functools.cache(opendrive_root), functools.cache(AlpasimMap)
_written: dict[bytes, bytes | None] = {}


@pytest.fixture(scope="session", autouse=True)
def _equal_maps_are_written_once():
    """Most archives of these tests hold the same map; tests of the map itself call ``opendrive_map``."""
    write = sidecars.opendrive_map

    def once(*given):
        key = pickle.dumps(given)
        if key not in _written:
            _written[key] = write(*given)
        return _written[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sidecars, "opendrive_map", once)
        yield


@pytest.fixture
def quick_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that validate many archives: the map takes most of the time, so that each one is read once.

    Of 200 cars beside the path 10 are compared; ``test_scene_map.py`` compares all.
    """
    monkeypatch.setattr(alpasim_roads, "AlpasimMap", _map)
    monkeypatch.setattr(alpasim_roads, "PLACEMENTS", 10)
    for module in (maps, reader):
        monkeypatch.setattr(module, "opendrive_root", _root)
