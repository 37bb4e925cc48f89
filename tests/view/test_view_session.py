"""The session, its drawing thread, and what can be opened; no browser and no viser."""

import contextlib
import dataclasses
import threading
import time

import numpy as np
import pytest
import serving_world
import view_worlds

from nurec_sim import geometry, runs, scene
from nurec_sim.errors import NurecSimError, RequestError, RunError
from nurec_sim.runs.scene_file import record_scene, save_scene_record
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.view import Session, View, open_sources
from nurec_sim.view import drawing as drawing_module
from nurec_sim.view.drawing import DrawingThread


class SlowPainter:
    """Stands in for a painter: keeps what it was asked for, and takes time."""

    def __init__(self, seconds=0.02):
        self.seconds, self.painted, self.fault = seconds, [], None
        self.stage = None

    def paint(self, view, scale, selected):
        time.sleep(self.seconds * scale**2)
        if self.fault:
            raise self.fault
        self.painted.append((view.t_us, scale, view.moving))
        return np.zeros((2, 2, 3), np.uint8)


@contextlib.contextmanager
def drawing(painter, told=None):
    session, shown = Session(View(0)), []
    thread = DrawingThread(
        session, painter, lambda picture, full: shown.append(full), (told if told is not None else []).append
    )
    thread.start()
    try:
        yield session, shown
    finally:
        thread.stop()
    assert not thread.is_alive()


def until(holds, timeout_s=10.0):
    end = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end, "not in time"
        time.sleep(0.005)


def test_stale_views_are_dropped_and_the_last_is_drawn_in_full():
    painter = SlowPainter(0.1)
    with drawing(painter) as (session, shown):
        for t_us in range(1, 101):
            session.change(moving=True, t_us=t_us)
            time.sleep(0.003)
        until(lambda: shown and shown[-1] and painter.painted[-1][0] == 100)
        coarse = [entry for entry in painter.painted if entry[2]]
        assert 2 <= len(coarse) < 60  # of 100 views
        assert painter.painted[-1] == (100, 1.0, False)
        # Pictures that take too long become smaller: 0.1 s at full size, 0.05 s are wanted.
        assert coarse[-1][1] < 0.85
        count = len(painter.painted)
        time.sleep(2 * drawing_module.STILL_AFTER_S)
        assert len(painter.painted) == count  # nothing changes, nothing is drawn


def test_an_error_is_told_once_and_the_tab_lives_on():
    painter, told = SlowPainter(0.0), []
    painter.fault = RequestError("no such time")
    with drawing(painter, told) as (session, shown):
        until(lambda: told)
        assert not shown
        painter.fault = None
        session.change(t_us=5)
        until(lambda: shown)
    assert told == ["no such time", ""]


def test_changes_from_many_threads_are_all_kept():
    session = Session(View(0))
    threads = [threading.Thread(target=lambda: [session.change(wipe=0.1) for _ in range(200)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert session.version == 800


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    paths = [folder / "lift.usdz", folder / "dense.usdz"]
    for seed, path in enumerate(paths):
        scene.write_scene(view_worlds.scene(seed), path)
    return paths


def opened(*sources, **options):
    with contextlib.ExitStack() as stack:
        return open_sources(sources, device="cpu", threads=1, stack=stack, **options)


def test_archives_of_one_log_open_together(archives, tmp_path):
    found = opened(*map(str, archives))
    assert [world.name for world in found.worlds] == ["lift", "dense"] and found.clip is None
    assert [world.name for world in opened(archives[0], archives[0]).worlds] == ["lift 1", "lift 2"]
    made = view_worlds.scene()
    path = geometry.pose_from_xyyaw(100.0, 0, 0) @ made.ego.world_from_body
    far = dataclasses.replace(made, id="other", ego=dataclasses.replace(made.ego, world_from_body=path))
    scene.write_scene(far, tmp_path / "far.usdz")
    with pytest.raises(RequestError, match="'street' and 'other' are not reconstructions of one log.*100.0 m apart"):
        opened(archives[0], tmp_path / "far.usdz")


def test_what_cannot_be_opened_is_said(archives, tmp_path):
    with pytest.raises(NurecSimError, match="nothing to view: give scene archives, logs, a run folder, or HOST:PORT"):
        opened()
    with pytest.raises(NurecSimError, match="missing.usdz does not exist"):
        opened(tmp_path / "missing.usdz")


def test_a_folder_of_other_things_is_told_what_can_be_viewed(archives, tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    takes = r"give scene archives \(.usdz\), logs \(docs/log_formats.md\), a run folder"
    with pytest.raises(RequestError, match=f"notes.txt is nothing to view: {takes}"):
        opened(tmp_path / "notes.txt")
    within = archives[0].parent
    with pytest.raises(RequestError, match=f"{takes}.*HOST:PORT of a server. In it: .*{archives[0].name}"):
        opened(within)


def test_a_run_opens_with_its_scene(archives, tmp_path):
    rollout, made = view_worlds.rollout(), scene.read_scene(archives[0])
    folder = tmp_path / "run" / "street" / "lift"
    (folder / "route_follower" / "0").mkdir(parents=True)
    runs.save_rollout(rollout, folder / "route_follower" / "0" / "rollout.npz")
    save_scene_record(record_scene(made), folder)
    found = opened(tmp_path / "run", archives[1], archives[0])
    assert list(found.rollouts) == ["route_follower, lift, seed 0"] and not found.notes
    assert found.world_of(rollout) == 1  # the scene that it was driven in
    assert "which is not among those given" in opened(tmp_path / "run", archives[1]).notes[0]
    # Without a scene: the one among the cached reconstructions whose content it is.
    with pytest.raises(
        RunError, match="driven in scene 'street' .lift., which is not among the cached reconstructions"
    ):
        opened(tmp_path / "run", cache_dir=tmp_path / "empty")
    for index, path in enumerate(archives):
        (tmp_path / "cache").mkdir(exist_ok=True)
        (tmp_path / "cache" / f"street-lift-{index}.usdz").write_bytes(path.read_bytes())
    (world,) = opened(tmp_path / "run", cache_dir=tmp_path / "cache").worlds
    assert scene.scene_hash(world.scene) == record_scene(made).sha256


def test_a_server_shows_the_same_as_the_scene_itself(archives):
    from nurec_sim.view import Painter

    store = SceneStore([serving_world.scene("one"), archives[0]], device="cpu")
    view = View(view_worlds.START_US + 630_000, (160, 100), camera="wide", route=False, lidar="roof",
                hidden=frozenset({"car-1"}))  # fmt: skip
    with SensorServer(store, port=0) as address, contextlib.ExitStack() as stack:
        with pytest.raises(RequestError, match=f"{address} serves 2 scenes: choose with {address}/SCENE; have "):
            opened(address)
        remote = open_sources([f"{address}/street"], stack=stack)
        shown = Painter(remote).paint(view)
    assert remote.worlds[0].layers == ("rgb",) and remote.worlds[0].scene is None
    assert np.array_equal(shown, Painter(opened(archives[0])).paint(view))
