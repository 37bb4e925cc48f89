"""The folder of training clips: filled by processes, checked, gone on with; and the stream of samples from it."""

import dataclasses
import multiprocessing
import os
import shutil
import time

import numpy as np
import pytest
import torch
import training_clips
import training_workers

from nurec_sim.errors import ClipError
from nurec_sim.network.profiles import PROFILES
from nurec_sim.network.tensors import SemanticClass
from nurec_sim.training.data import cache as cache_module
from nurec_sim.training.data import stream as stream_module
from nurec_sim.training.data.cache import ClipCache
from nurec_sim.training.data.clips import UNFINISHED_PREFIX
from nurec_sim.training.data.generate import ClipSettings, clip_ids, generate_town
from nurec_sim.training.data.stream import SampleStream, clip_order, draw_sample
from nurec_sim.training.data.windows import WindowSettings, sample_window

SETTINGS = ClipSettings(frames=2, pixels=12_544, clips_per_town=1, seconds=2.0)
TOWN = 7
"""Its first rig has one plain camera, which is quickly drawn."""
PROFILE = dataclasses.replace(PROFILES["tiny"], width_px=56, height_px=42)
WINDOWS = WindowSettings(PROFILE, frames={2: 1.0}, targets=1)


def cache_with(folder, count):
    """A cache of closed-form clips under the names that towns would have."""
    settings = ClipSettings(clips_per_town=2)
    where = folder / settings.hash
    where.mkdir(parents=True)
    for town in range(count // 2):
        for name in clip_ids(town, settings):
            training_clips.write_clip(where / name, frames=4)
    return settings


def test_clips_of_other_settings_lie_elsewhere():
    assert SETTINGS.hash == dataclasses.replace(SETTINGS).hash
    others = [dataclasses.replace(SETTINGS, frames=3), dataclasses.replace(SETTINGS, split="test")]
    assert len({settings.hash for settings in [SETTINGS, *others]}) == 3


@pytest.mark.parametrize("change", [{"frames": 1}, {"pixels": 100}, {"clips_per_town": 0}, {"frames": 200}])
def test_clip_settings_out_of_range_are_refused(change):
    with pytest.raises(ValueError):
        dataclasses.replace(SETTINGS, **change)


def test_damaged_and_unfinished_clips_are_dropped_and_the_rest_is_kept(tmp_path):
    settings = cache_with(tmp_path, 6)
    whole = ClipCache(tmp_path, settings, 6)
    folder, before = whole.clips, whole.data_hash()
    rgb = folder / "train-000001-0" / "0_rgb.npy"
    rgb.write_bytes(rgb.read_bytes()[:1000])
    (folder / "train-000002-1" / "meta.json").unlink()
    (folder / f"{UNFINISHED_PREFIX}999999999-train-000009-0").mkdir()
    (folder / f"{UNFINISHED_PREFIX}{os.getpid()}-train-000008-0").mkdir()
    lines = []
    cache = ClipCache(tmp_path, settings, 6, report=lines.append)
    assert cache.clip_ids() == ["train-000000-0", "train-000000-1", "train-000001-1", "train-000002-0"]
    assert len(lines) == 2 and all("damaged" in line for line in lines)
    assert [path.name for path in folder.glob(".*")] == [f"{UNFINISHED_PREFIX}{os.getpid()}-train-000008-0"]
    assert cache.data_hash() != before


def test_only_missing_towns_are_drawn_and_refreshing_goes_beyond(tmp_path):
    settings = cache_with(tmp_path, 4)
    cache = ClipCache(tmp_path, settings, 12)
    shutil.rmtree(cache.clips / "train-000001-1")
    assert [town for batch in cache._wanted_towns(False) for town in batch] == [1, 2, 3, 4, 5]
    full = ClipCache(tmp_path, settings, 3)
    assert next(full._wanted_towns(True)) == (2, 3, 4)


def test_refreshing_drops_the_oldest_clips(tmp_path):
    settings = cache_with(tmp_path, 4)
    cache = ClipCache(tmp_path, settings, 2)
    os.utime(cache.clips / "train-000000-1", (1, 1))
    os.utime(cache.clips / "train-000001-0", (2, 2))
    cache._drop_oldest()
    assert cache.clip_ids() == ["train-000000-0", "train-000001-1"]


def test_step_n_of_rank_r_is_sample_n_times_ranks_plus_r(tmp_path, monkeypatch):
    monkeypatch.setattr(stream_module, "ready_clips", lambda folder: ["clip"])
    monkeypatch.setattr(stream_module, "draw_sample", lambda folder, settings, seed, index: (seed, index))
    for rank in range(3):
        with SampleStream(tmp_path, WINDOWS, seed=5, start=4, rank=rank, world_size=3) as stream:
            assert [next(stream) for _ in range(3)] == [(5, 12 + rank), (5, 15 + rank), (5, 18 + rank)]


def test_each_sample_has_its_clip_and_random_numbers_of_its_own(tmp_path, monkeypatch):
    names = [f"train-{k:06d}-0" for k in range(9)]
    monkeypatch.setattr(stream_module, "ready_clips", lambda folder: names)
    monkeypatch.setattr(stream_module, "CachedClip", lambda path: path.name)
    monkeypatch.setattr(stream_module, "sample_window", lambda rng, clip, settings: (clip, rng.random()))
    samples = [draw_sample(tmp_path, WINDOWS, 2, index) for index in range(12)]
    assert [clip for clip, _ in samples] == [clip_order(2, index, names)[0] for index in range(12)]
    assert len({number for _, number in samples}) == 12
    assert draw_sample(tmp_path, WINDOWS, 2, 5) == samples[5] != draw_sample(tmp_path, WINDOWS, 3, 5)


@pytest.mark.slow
def test_a_failing_worker_is_reported_and_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(cache_module, "TRIALS", 1)
    lines = []
    # Longer than any town's traffic lasts, which only the worker finds out.
    cache = ClipCache(tmp_path, dataclasses.replace(SETTINGS, seconds=1000.0), 1, report=lines.append)
    with pytest.raises(ClipError, match="0 of 1"):
        cache.fill(backend="rays")
    assert len(lines) == 1 and "status 1" in lines[0]


@pytest.mark.slow
def test_a_process_fills_the_cache_and_a_second_run_goes_on(tmp_path):
    seen = []
    ClipCache(tmp_path, SETTINGS, 1, TOWN).fill(
        progress=lambda done, wanted: seen.append((done, wanted)), backend="rays"
    )
    cache = ClipCache(tmp_path, SETTINGS, 1, TOWN)
    assert seen[-1] == (1, 1) and cache.clip_ids() == ["train-000007-0"]
    written = (cache.clips / "train-000007-0" / "meta.json").stat().st_mtime_ns
    cache.fill(backend="rays")
    assert (cache.clips / "train-000007-0" / "meta.json").stat().st_mtime_ns == written
    clip = cache.clip("train-000007-0")
    assert len(clip.plan_hash) == 64 and len(cache.data_hash()) == 64
    check_drawn_clip(clip)


@pytest.mark.slow
def test_a_town_has_the_same_bytes_in_every_process(tmp_path):
    cache = ClipCache(tmp_path, SETTINGS, 1, TOWN)
    cache.fill(backend="rays")
    (again,) = generate_town(TOWN, SETTINGS, tmp_path / "again", "rays")
    files = sorted(path.name for path in again.iterdir())
    assert len(files) >= 12
    for name in files:
        assert (again / name).read_bytes() == (cache.clips / "train-000007-0" / name).read_bytes(), name


def check_drawn_clip(clip):
    """What the true world drew must make a sample whose truth fits."""
    for camera in clip.rig.cameras.values():
        truth = clip.truth(camera.id, 1)
        assert abs(camera.width_px * camera.height_px / 12_544 - 1) < 0.11
        assert ((truth.depth_m > 0) | (truth.label == 3) | (truth.label == 0)).all() and (
            truth.depth_m > 0
        ).mean() > 0.3
        pose = clip.ego.at(int(clip.camera_times_us(camera.id)[1, 0])) @ camera.rig_from_camera
        np.testing.assert_allclose(pose, clip.world_from_camera(camera.id, 1)[0], atol=1e-9)
    sample = sample_window(np.random.default_rng(0), clip, WINDOWS)
    assert (sample.truth.semantic == SemanticClass.ROAD).any() and sample.truth.normal.abs().sum() > 0


# ------------------------------------------------------------------------------------------------------------- stream


def test_samples_follow_from_seed_and_number_and_a_resumed_stream_repeats_them(tmp_path):
    settings = cache_with(tmp_path, 6)
    folder = tmp_path / settings.hash
    with SampleStream(folder, WINDOWS, seed=3) as stream:
        whole = [next(stream) for _ in range(6)]
    with SampleStream(folder, WINDOWS, seed=3, start=4) as stream:
        resumed = [next(stream) for _ in range(2)]
    for sample, again in zip(whole[4:], resumed, strict=True):
        assert sample.id == again.id and torch.equal(sample.inputs.rgb, again.inputs.rgb)
    assert len({sample.id.split("/")[0] for sample in whole}) > 2
    with SampleStream(folder, WINDOWS, seed=4) as stream:
        assert next(stream).id != whole[0].id


@pytest.mark.slow
def test_ranks_share_the_samples_and_workers_change_nothing(tmp_path):
    settings = cache_with(tmp_path, 4)
    folder = tmp_path / settings.hash
    alone = [draw_sample(folder, WINDOWS, 1, index).id for index in range(4)]
    with SampleStream(folder, WINDOWS, 1, workers=1) as first:
        assert [next(first).id for _ in range(2)] == alone[:2]
    for rank in range(2):
        with SampleStream(folder, WINDOWS, 1, rank=rank, world_size=2) as stream:
            assert [next(stream).id for _ in range(2)] == alone[rank::2]


def test_a_new_clip_changes_only_the_samples_that_it_wins():
    before = [f"train-{k:06d}-0" for k in range(20)]
    chosen = [(clip_order(0, k, before)[0], clip_order(0, k, [*before, "train-000020-0"])[0]) for k in range(400)]
    changed = [new for old, new in chosen if new != old]
    assert set(changed) == {"train-000020-0"} and 5 < len(changed) < 45
    assert len({old for old, _ in chosen}) == 20


def test_a_clip_that_is_gone_or_damaged_is_passed_over(tmp_path):
    settings = cache_with(tmp_path, 4)
    folder = tmp_path / settings.hash
    first, second, *_ = clip_order(0, 7, [path.name for path in folder.iterdir()])
    (folder / first / "meta.json").unlink()
    assert draw_sample(folder, WINDOWS, 0, 7).id.startswith(second)


def test_a_stream_without_clips_says_so(tmp_path):
    with (
        SampleStream(tmp_path / "none", WINDOWS, 0, wait_s=0.0) as stream,
        pytest.raises(ClipError, match="no training"),
    ):
        next(stream)
    with pytest.raises(ValueError, match="rank below"):
        SampleStream(tmp_path, WINDOWS, 0, rank=1)


# ------------------------------------------------------------------------------------------------------------ workers


def test_a_worker_ends_when_its_parent_is_killed():
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    parent = context.Process(target=training_workers.parent_of_a_worker, args=(theirs,))
    parent.start()
    assert mine.poll(30)
    worker = mine.recv()
    parent.kill()
    parent.join()
    deadline = time.monotonic() + 20
    while cache_module.is_alive(worker) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not cache_module.is_alive(worker)
