"""Kernels that a process beside the first reconstruction compiles ahead."""

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from reconstruct_street import Street

from nurec_sim.reconstruct import ahead, reconstruct
from nurec_sim.reconstruct.small_scene import draw_small_scene, lift_small_log

LIFTED = """
import sys
sys.path.insert(0, {helpers!r})
from reconstruct_street import Street
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
reconstruct(Street(frames=4), settings=LiftSettings(sky_px=32, views=ViewSettings(levels=32)))
kernels = {{value for module in list(sys.modules.values()) if module.__name__.startswith("nurec_sim")
           for value in vars(module).values() if hasattr(value, "signatures")}}
for kernel in kernels:
    counts = kernel.stats.cache_hits, kernel.stats.cache_misses
    print(kernel.py_func.__name__, *(sum(each.values()) for each in counts))
"""


@pytest.fixture
def started(monkeypatch, tmp_path) -> Iterator[list[list[str]]]:
    """What has been started, on two cores and with kernels missing."""
    commands: list[list[str]] = []
    monkeypatch.setattr(ahead, "_started", [])
    monkeypatch.setattr(ahead, "usable_cores", lambda: 2)
    monkeypatch.setattr(ahead, "_locks", [])
    monkeypatch.setattr(ahead, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(ahead.atexit, "register", lambda *arguments: None)
    monkeypatch.setattr(ahead.subprocess, "Popen", lambda command, **options: commands.append(command))
    yield commands
    for lock in ahead._locks:
        lock.close()


def test_one_process_is_started(started):
    assert not ahead.compiled(ahead.cache_folder())
    ahead.compile_ahead()
    ahead.compile_ahead()
    assert started == [[sys.executable, "-m", "nurec_sim.reconstruct.small_scene"]]


def test_none_is_started_beside_that_of_another_process(started, tmp_path):
    (tmp_path / "cache").mkdir()
    with (tmp_path / "cache" / "ahead.lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        ahead.compile_ahead()
        assert not started
    ahead.compile_ahead()
    assert len(started) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [("usable_cores", lambda: 1), ("cache_folder", lambda: None), ("compiled", lambda folder: True)],
)
def test_none_is_started_without_a_core_a_cache_or_need(started, monkeypatch, name, value):
    monkeypatch.setattr(ahead, name, value)
    ahead.compile_ahead()
    assert not started


def test_a_reconstruction_begins_with_it(monkeypatch):
    class BegunError(Exception):
        pass

    def begin() -> None:
        raise BegunError

    monkeypatch.setattr(ahead, "compile_ahead", begin)
    with pytest.raises(BegunError):
        reconstruct(Street(frames=2))


def test_kernels_are_missing_until_they_have_been_compiled():
    draw_small_scene()
    assert ahead.compiled(ahead.cache_folder())


def test_the_small_log_passes_through_all_stages():
    scene = lift_small_log()
    assert len(scene.static) > 1000 and (scene.static.intensity > 0).any() and scene.static.ray_drop is not None


@pytest.mark.slow
def test_a_log_then_finds_nearly_all_kernels(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    root = Path(__file__).parents[2]
    subprocess.run([sys.executable, "-m", ahead.MODULE], env=environment, check=True, cwd=root)
    script = LIFTED.format(helpers=str(root / "tests" / "helpers"))
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, check=True, cwd=root, capture_output=True, text=True
    )
    found = {name: (int(hits), int(misses)) for name, hits, misses in map(str.split, done.stdout.splitlines())}
    used = {name for name, counts in found.items() if sum(counts)}
    assert {"_draw_tiles", "_draw_tiles_back", "sweep_returns", "principal_axes", "owned", "fuse"} <= used
    missed = {name for name, (_, misses) in found.items() if misses}
    assert len(missed) <= 0.05 * len(used), missed
