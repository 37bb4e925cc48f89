"""Reconstructions on disk: under a name that says what they depend on, whole or not at all, whatever dies meanwhile."""

import errno
import os
import signal
import subprocess
import sys
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import tiny_clip
from serving_calls import wait_until
from serving_world import scene

import nurec_sim.logs
import nurec_sim.reconstruct
from nurec_sim.errors import ReconstructError, WeightsError
from nurec_sim.reconstruct import FeedForwardSettings, LiftSettings, OptimizeSettings, ViewSettings
from nurec_sim.render import CpuRenderer
from nurec_sim.serving.store import Recipe, SceneStore, content_key

HERE = Path(__file__).parents[1] / "helpers"
SMALL = LiftSettings(sky_px=16, views=ViewSettings(levels=8))


@pytest.fixture
def clip(tmp_path):
    return tiny_clip.write(tmp_path / "drive.zip")


@pytest.fixture
def made(monkeypatch):
    """Counts reconstructions, which take no time."""
    calls = []

    def reconstruct(clip, method, **chosen):
        calls.append((method, chosen))
        return scene("tiny")

    monkeypatch.setattr(nurec_sim.reconstruct, "reconstruct", reconstruct)
    return calls


def store_of(clip, cache, **options):
    return SceneStore([clip], cache_dir=cache, make_renderer=lambda world: CpuRenderer(world, threads=1), **options)


def test_a_clip_is_lifted_with_the_settings_of_the_store_and_kept(clip, tmp_path):
    first = store_of(clip, tmp_path / "cache", settings=SMALL).get("tiny").scene
    (kept,) = (tmp_path / "cache").iterdir()
    assert kept.name == f"{content_key(clip, Recipe('lift', SMALL))}.usdz" and len(first.sky[0]) == 16
    before = kept.stat().st_mtime_ns
    again = store_of(clip, tmp_path / "cache", settings=SMALL).get("tiny").scene
    assert np.array_equal(first.static.mean_m, again.static.mean_m) and kept.stat().st_mtime_ns == before


def test_the_name_depends_on_method_settings_cameras_and_weights(clip, tmp_path):
    weights = tmp_path / "w.safetensors"
    keys = []
    for content in (b"one", b"two"):
        weights.write_bytes(content)
        keys.append(content_key(clip, Recipe("dense", FeedForwardSettings(checkpoint=weights))))
    copy = tmp_path / "elsewhere.safetensors"
    copy.write_bytes(b"two")
    assert content_key(clip, Recipe("dense", FeedForwardSettings(checkpoint=copy))) == keys[1]
    recipes = [
        Recipe("lift"),
        Recipe("lift", SMALL),
        Recipe("lift", cameras=("front",)),
        *(Recipe("dense", FeedForwardSettings(random_weights=seed)) for seed in (1, 2)),
        Recipe("selective", FeedForwardSettings(random_weights=1)),
        *(Recipe("lift", refine=OptimizeSettings(seconds=seconds)) for seconds in (10.0, 20.0)),
    ]
    keys += [content_key(clip, recipe) for recipe in recipes]
    assert len(set(keys)) == len(keys) == 10
    assert keys == [*keys[:2], *(content_key(clip, recipe) for recipe in recipes)]


def test_weights_that_are_missing_are_an_error_of_the_load(clip, tmp_path):
    settings = FeedForwardSettings(checkpoint=tmp_path / "nothing.pth")
    with pytest.raises(WeightsError, match=r"no weights at .*nothing.pth"):
        store_of(clip, tmp_path / "cache", method="dense", settings=settings).get("tiny")
    assert list((tmp_path / "cache").iterdir()) == []


def test_recipes_are_checked_when_the_store_is_made(clip):
    with pytest.raises(ReconstructError, match="unknown reconstruction method 'magic'; have"):
        SceneStore([clip], method="magic")


def test_settings_and_cameras_reach_the_method(clip, made, tmp_path):
    store = store_of(clip, tmp_path / "cache")
    store.offer(clip, "one-eyed", Recipe("dense", FeedForwardSettings(random_weights=3), ("front",)))
    store.get("one-eyed")
    store.get("tiny")
    (method, chosen), (plain, nothing) = made
    assert method == "dense" and chosen["settings"].random_weights == 3 and chosen["cameras"] == ("front",)
    assert plain == "lift" and "settings" not in nothing and "cameras" not in nothing
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_a_clip_is_refined_before_it_is_kept_and_not_kept_if_interrupted(clip, made, tmp_path):
    store_of(clip, tmp_path / "cache", refine=OptimizeSettings(seconds=5.0)).get("tiny")
    ((method, chosen),) = made
    assert method == "lift" and chosen["refine"] == OptimizeSettings(seconds=5.0, keep_interrupted=False)


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped"])
def test_a_damaged_file_is_made_again(clip, made, tmp_path, caplog, damage):
    cache = tmp_path / "cache"
    store_of(clip, cache).get("tiny")
    (kept,) = cache.iterdir()
    whole = kept.read_bytes()
    with zipfile.ZipFile(kept) as members:
        largest = max((m for m in members.infolist() if m.filename.endswith(".usdc")), key=lambda m: m.file_size)
    middle = largest.header_offset + 256 + largest.file_size // 2
    flipped = whole[:middle] + bytes(255 - byte for byte in whole[middle : middle + 64]) + whole[middle + 64 :]
    kept.write_bytes({"empty": b"", "cut": whole[:middle], "flipped": flipped}[damage])
    assert store_of(clip, cache).get("tiny").scene.id == "tiny"
    assert len(made) == 2 and kept.read_bytes() == whole and list(cache.iterdir()) == [kept]
    assert "its kept reconstruction is damaged" in caplog.text


@pytest.mark.parametrize("call", ["fsync", "replace", "open"])
def test_a_full_disk_is_a_warning_and_the_scene_is_served(clip, made, tmp_path, monkeypatch, caplog, call):
    other = tiny_clip.write(tmp_path / "other.zip", id="other")
    cache = tmp_path / "cache"
    cache.mkdir()
    store = store_of(clip, cache)
    store.add(other)
    real = getattr(os, call)

    def full(*arguments, **options):
        if call == "open" and ".lock" not in str(arguments[0]):
            return real(*arguments, **options)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, call, full)
    for name in ("tiny", "other"):
        assert len(store.get(name).scene.static)
    monkeypatch.undo()
    warned = [record for record in caplog.records if "could not be kept" in record.message]
    assert len(warned) == 1 and "No space left on device" in warned[0].message
    assert list(cache.iterdir()) == [] and len(made) == 2


def test_two_stores_of_one_folder_reconstruct_once(clip, tmp_path, monkeypatch):
    begun, gate, heard = [], threading.Event(), []

    def slow(clip, method, progress, **_):
        begun.append(method)
        assert gate.wait(20)
        return scene("tiny")

    monkeypatch.setattr(nurec_sim.reconstruct, "reconstruct", slow)
    cache = tmp_path / "cache"
    first, second = store_of(clip, cache), store_of(clip, cache)
    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(store.get, "tiny", lambda *said: heard.append(said)) for store in (first, second)]
        wait_until(lambda: begun and any("waiting for another process" in stage for stage, _ in heard))
        third = store_of(clip, cache)  # what it finds belongs to one that lives
        assert [path.suffix for path in cache.iterdir()] == [".lock"]
        gate.set()
        assert all(job.result(20).scene.id == "tiny" for job in jobs)
    assert third.get("tiny").scene.id == "tiny" and len(begun) == 1
    assert [path.suffix for path in cache.iterdir()] == [".usdz"]


KEEPER = """
import os, sys, time
import nurec_sim.reconstruct
from serving_world import scene
from nurec_sim.serving.store import SceneStore

def hang(handle):
    print("keeping", flush=True)
    time.sleep(60)

def reconstruct(clip, method, **_):
    if sys.argv[3] == "reconstructing":
        hang(0)
    os.fsync = hang
    return scene("tiny")

nurec_sim.reconstruct.reconstruct = reconstruct
SceneStore([sys.argv[1]], cache_dir=__import__("pathlib").Path(sys.argv[2])).get("tiny")
"""


@pytest.mark.parametrize("moment", ["reconstructing", "writing"])
def test_what_a_killed_process_leaves_is_removed(clip, made, tmp_path, moment, caplog):
    cache = tmp_path / "cache"
    command = [sys.executable, "-c", KEEPER, str(clip), str(cache), moment]
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=HERE.parents[1]) as process:
        assert process.stdout.readline() == "keeping\n"
        left = {path.suffix for path in cache.iterdir()}
        assert left == ({".lock"} if moment == "reconstructing" else {".lock", ".part"})
        store_of(clip, cache)
        assert {path.suffix for path in cache.iterdir()} == left, "the process lives, so nothing is touched"
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        assert {path.suffix for path in cache.iterdir()} == left
    store = store_of(clip, cache)
    assert list(cache.iterdir()) == []
    assert ("removed what an interrupted reconstruction left" in caplog.text) == (moment == "writing")
    assert store.get("tiny").scene.id == "tiny" and len(made) == 1
    assert [path.suffix for path in cache.iterdir()] == [".usdz"]


def test_files_of_others_are_left_alone(clip, made, tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    names = {".something.part", ".picture.usdz.x1.part", "notes.txt", ".drive-lift-0123.usdz.a.part"}
    for name in names:
        (cache / name).write_text("mine")
    store_of(clip, cache).get("tiny")
    assert {path.name for path in cache.iterdir() if path.suffix != ".usdz"} == names
