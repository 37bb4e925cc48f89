"""Scenes in memory: lent, counted, bounded by number and bytes, loaded once."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from serving_calls import wait_until
from serving_world import scene

from nurec_sim.errors import ArchiveError, CancelledError, SceneInUseError, UnknownSceneError
from nurec_sim.render import CpuRenderer
from nurec_sim.scene import write_scene
from nurec_sim.scene.describe import scene_arrays
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.store.memory import array_bytes, half_of_memory


def one_thread(world):
    return CpuRenderer(world, threads=1)


def store_of(names, **options):
    return SceneStore([scene(name) for name in names], make_renderer=one_thread, **options)


def test_a_scene_in_use_is_never_evicted():
    store = store_of("abc", capacity=1)
    with store.lease("a") as first, store.lease("b"):
        assert store.get("c").scene.id == "c"
        assert store.loaded_ids == ("clipgt-a", "clipgt-b", "clipgt-c") and store.stats.in_use == 2
        with store.lease_in_memory("a") as again:
            assert again is first
    assert store.loaded_ids == ("clipgt-a",), "room is made when the leases end; the one used last stays"


def test_a_lease_ends_once_however_often_it_is_released():
    store = store_of("ab", capacity=1)
    held, other = store.lease("a"), store.lease("a")
    held.release()
    held.release()
    store.get("b")
    assert "clipgt-a" in store.loaded_ids
    other.release()
    assert store.loaded_ids == ("clipgt-b",)


def test_scenes_are_bounded_by_bytes_too():
    size = array_bytes(store_of("a").get("a"))
    store = store_of("abcd", max_bytes=2 * size + size // 2)
    for name in "abca":
        store.get(name)
    assert store.loaded_ids == ("clipgt-c", "clipgt-a") and store.stats.evictions == 2
    assert store.stats.loaded_bytes == 2 * size and store.max_bytes == 2 * size + size // 2
    with store.lease("c"):
        store.get("d")
        assert store.loaded_ids == ("clipgt-c", "clipgt-d")


def test_a_scene_larger_than_the_bound_is_served_alone():
    store = store_of("ab", max_bytes=1000)
    for name in "aabb":
        store.get(name)
    assert store.loaded_ids == ("clipgt-b",)
    assert (store.stats.loads, store.stats.hits, store.stats.evictions) == (2, 2, 1)


@pytest.mark.parametrize("wrong", [{"capacity": 0}, {"max_bytes": 0}])
def test_a_store_without_room_is_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} 0"):
        SceneStore(**wrong)


def test_the_size_of_a_scene_counts_the_renderers_arrays_and_each_buffer_once():
    world = scene()
    arrays = sum(array.nbytes for array in scene_arrays(world).values())
    assert arrays <= array_bytes(world) < 1.5 * arrays + 20_000  # poses and sensors are arrays too
    assert array_bytes(world, world) == array_bytes(world)
    assert array_bytes(one_thread(world), world) > array_bytes(world)
    whole = np.zeros(1000)
    assert array_bytes([whole[:10], {"x": (whole[5:], whole)}]) == 8000
    assert array_bytes(None, "text", {1, 2}, np.float64(1.0)) == 8


def test_memory_is_bounded_by_half_of_what_there_is_unless_said_otherwise():
    assert SceneStore().max_bytes == half_of_memory() > 1 << 28


def test_everything_is_counted(tmp_path):
    path = write_scene(scene("stored"), tmp_path / "stored.usdz")
    store = SceneStore([scene("a"), path], capacity=1, make_renderer=one_thread)
    store.get("a")
    store.get("a")
    store.get("stored")
    path.write_bytes(b"damaged")
    store.unload("stored")
    with pytest.raises(ArchiveError):
        store.get("stored")
    stats = store.stats
    assert (stats.loads, stats.hits, stats.failed_loads, stats.evictions) == (2, 1, 1, 1)
    assert (stats.loaded, stats.loaded_bytes, stats.in_use) == (0, 0, 0) and stats.load_s > 0


def test_many_threads_never_lose_a_scene_that_they_use():
    store, begun = store_of("abc", capacity=1), threading.Barrier(6)

    def use(seed):
        begun.wait(20)
        for name in np.random.default_rng(seed).choice(list("abc"), 40):
            with store.lease(name) as loaded:
                assert f"clipgt-{name}" in store.loaded_ids and loaded.scene.id == name

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(use, range(6)))
    assert store.stats.in_use == 0 and store.stats.loaded == 1
    assert store.stats.hits + store.stats.loads <= 6 * 40, "a wait for the load of another is neither"


class Clips:
    """Reconstructions that wait to be let through and hear whether they are wanted."""

    def __init__(self, monkeypatch, folder):
        import nurec_sim.logs
        import nurec_sim.reconstruct

        self.folder = folder / "drive"
        self.folder.mkdir()
        (self.folder / "data.bin").write_bytes(b"one")
        self.begun, self.gate = [], threading.Event()
        monkeypatch.setattr(nurec_sim.logs, "open_clip", lambda path: scene("drive"))
        monkeypatch.setattr(nurec_sim.reconstruct, "reconstruct", self.reconstruct)

    def reconstruct(self, clip, method, progress, **_):
        self.begun.append(method)
        while not self.gate.wait(0.01):
            progress("waiting", 0.5)
        return scene("drive")


def test_a_load_that_one_gives_up_is_begun_anew_for_who_waits(monkeypatch, tmp_path):
    clips = Clips(monkeypatch, tmp_path)
    store = SceneStore([clips.folder], cache_dir=tmp_path / "cache", make_renderer=one_thread)
    left = threading.Event()

    def progress(stage, fraction):
        if left.is_set():
            raise CancelledError("the client left")

    with ThreadPoolExecutor(2) as pool:
        impatient = pool.submit(store.get, "drive", progress)
        wait_until(lambda: clips.begun)
        patient = pool.submit(store.get, "drive")
        wait_until(lambda: store.entries[0].users == 2)
        assert store.entries[0].loading and store.loaded_ids == ()
        left.set()
        assert isinstance(impatient.exception(20), CancelledError)
        wait_until(lambda: len(clips.begun) == 2)
        clips.gate.set()
        assert patient.result(20).scene.id == "drive"
    assert store.stats.failed_loads == 1 and store.stats.loads == 1


def test_a_scene_can_be_unloaded_and_removed_unless_somebody_uses_it():
    store = store_of("ab")
    with store.lease("a"):
        for take_away in (store.unload, store.remove):
            with pytest.raises(SceneInUseError, match=r"scene 'clipgt-a' is in use \(1 calls\)"):
                take_away("a")
    assert set(store.ids) == {"clipgt-a", "clipgt-b"}
    assert store.unload("a") > 10_000 and store.unload("a") == 0 and store.loaded_ids == ()
    store.remove("a")
    assert store.ids == ("clipgt-b",)
    with pytest.raises(UnknownSceneError):
        store.get("a")
    assert store.add(scene("a")) == ("clipgt-a",) and store.get("a").scene.id == "a"


def test_a_scene_can_be_offered_under_another_name(tmp_path):
    path = write_scene(scene("own"), tmp_path / "file.usdz")
    store = SceneStore([path], make_renderer=one_thread)
    assert store.offer(path, "copy") == "clipgt-copy"
    assert store.get("copy").scene.id == "own" and store.ids == ("clipgt-own", "clipgt-copy")
    with pytest.raises(ArchiveError, match="a scene of id 'clipgt-own' is already served"):
        store.offer(path)


def test_half_written_files_are_not_looked_at(tmp_path):
    write_scene(scene("whole"), tmp_path / "whole.usdz")
    (tmp_path / ".incoming-1234.usdz").write_bytes(b"half")
    (tmp_path / ".hidden").mkdir()
    (tmp_path / ".hidden" / "other.usdz").write_bytes(b"half")
    store = SceneStore([tmp_path])
    assert store.ids == ("clipgt-whole",) and store.faults == {}
