"""The network methods from a real clip to an archive and to rendered frames, with random weights of `tiny`."""

from pathlib import Path

import numpy as np
import pytest
import tiny_clip

from nurec_sim import scene
from nurec_sim.errors import ReconstructError, WeightsError
from nurec_sim.evaluate import evaluate
from nurec_sim.logs import open_clip
from nurec_sim.plugins import load_policy
from nurec_sim.reconstruct import FeedForwardSettings, LiftSettings, reconstruct
from nurec_sim.render.cpu.renderer import CpuRenderer
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.types import Label, SensorRequest

pytestmark = pytest.mark.slow

CAMERAS = ["front", "left", "wide"]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A pinhole with distortion, a fisheye and an F-theta camera behind glass; rolling shutters and a LiDAR."""
    return open_clip(tiny_clip.write(tmp_path_factory.mktemp("chain") / "clip"))


def quick(**changes):
    return FeedForwardSettings(**{"random_weights": 1, "sky_px": 32, **changes})


@pytest.fixture(scope="module")
def world(clip):
    stages = []
    settings = quick(lidar_depth="scale", max_gaussians=60_000)
    result = reconstruct(clip, "dense", cameras=CAMERAS, settings=settings, hold_out_sweeps=[1],
                         progress=lambda stage, fraction: stages.append((stage, fraction)))  # fmt: skip
    return result, stages


def test_every_layer_is_there(world):
    result, _ = world
    assert 0.9 * 60_000 <= len(result.static) - result.provenance["counts"]["ground_added"] <= 60_000
    assert Label.MOVABLE not in result.static.label
    assert len(result.dynamic) > 0
    assert (result.dynamic.gaussians.label == Label.MOVABLE).all()
    assert (np.diff(result.dynamic.knot_t_us, axis=1) > 0).all()
    assert result.sky.shape == (6, 32, 32, 3)
    assert list(result.isp) == CAMERAS
    assert len(result.provenance["chunks"]) == len(result.provenance["lidar_depth"]) == 1
    assert any("random weights" in text for text in result.provenance["unknown"])


def test_sweeps_tell_the_road_if_there_are_any(world, clip):
    result, _ = world
    assert result.provenance["road_labels"] == "lidar"
    (lidar,) = clip.rig.lidars
    everything = range(len(clip.sweep_times_us(lidar)))
    without = reconstruct(clip, "dense", cameras=["wide"], settings=quick(), hold_out_sweeps=everything)
    assert without.provenance["road_labels"] == "network"
    asked = reconstruct(clip, "dense", cameras=["wide"], settings=quick(road_labels="network"))
    assert asked.provenance["road_labels"] == "network"
    assert asked.provenance["counts"]["ground_added"] == 0 < result.provenance["counts"]["ground_added"]
    by_lidar = reconstruct(clip, "dense", cameras=["wide"], settings=quick(road_labels="lidar"))
    assert not np.array_equal(by_lidar.static.label, asked.static.label)
    with pytest.raises(ReconstructError, match="road_labels='lidar' needs sweeps that are not held out"):
        reconstruct(clip, "dense", settings=quick(road_labels="lidar"), hold_out_sweeps=everything)


@pytest.mark.slow
def test_several_chunks_become_one_scene():
    demo = open_clip(Path(__file__).parents[2] / "scenarios" / "demo_clip.zip")
    result = reconstruct(
        demo, "dense", cameras=["camera_front"], settings=quick(frames=13, overlap=0.0, max_gaussians=None)
    )
    counts = result.provenance["counts"]
    assert counts["chunks"] == len(result.provenance["chunks"]) == 2
    assert sum(counts["owned_by_others"]) > 0
    assert counts["static"] == sum(counts["static_before"]) - sum(counts["owned_by_others"])


def test_actors_and_blind_driving_are_the_same_whatever_the_method(world, clip):
    """Both methods take the actors from the log; what the network saw move besides is in the picture only."""
    scenes = [world[0], reconstruct(clip, "lift", cameras=["front"])]
    assert any(not track.actor for track in world[0].tracks), "random weights see things move"
    scenario = Scenario(name="brief", duration_s=0.2, warm_up_s=0.0)
    drives = [run_rollout(scenario, load_policy("route_follower"), lambda requests: [], each) for each in scenes]
    for drive in drives:
        assert drive.status == "ok" and drive.actor_labels == {track.id: track.label for track in clip.tracks}
    dense, lift = drives
    assert dense.world_from_rig.tobytes() == lift.world_from_rig.tobytes()
    assert dense.actor_sizes_m == lift.actor_sizes_m
    assert all(dense.actors[name].tobytes() == lift.actors[name].tobytes() for name in lift.actors)
    for (made, plan), (made_too, same) in zip(dense.plans, lift.plans, strict=True):
        assert made == made_too and plan.pose.tobytes() == same.pose.tobytes()


def test_progress_names_every_stage(world):
    _, stages = world
    names = [name for name, _ in stages]
    assert names[:3] == ["aligning sweeps", "aligning cameras", "weights"]
    assert any(name.startswith("chunk 1 of ") for name in names)
    assert {"merging", "tracks"} <= set(names)
    told = [fraction for _, fraction in stages]
    assert told == sorted(told) and (told[0], told[-1]) == (0.0, 1.0)


def test_archive_keeps_and_renderer_draws_it(world, clip, tmp_path):
    result, _ = world
    path = tmp_path / "world.usdz"
    scene.write_scene(result, path)
    again = scene.read_scene(path)
    assert len(again.static) == len(result.static)
    assert len(again.dynamic) == len(result.dynamic)
    start_us, end_us = (int(t) for t in clip.camera_times_us("front")[0])
    request = SensorRequest(again.id, clip.rig.cameras["front"], start_us, max(end_us, start_us + 1),
                            clip.world_from_camera("front", 0))  # fmt: skip
    frame = CpuRenderer(again).render_camera(request, ("rgb", "alpha"))
    assert frame.alpha.mean() > 0.1
    assert frame.rgb.std() > 1


@pytest.mark.slow
def test_same_clip_same_bytes(clip, tmp_path):
    for name in ("a", "b"):
        result = reconstruct(clip, "selective", cameras=["wide"], settings=quick(chunking="non-overlapping"))
        scene.write_scene(result, tmp_path / f"{name}.usdz")
    assert (tmp_path / "a.usdz").read_bytes() == (tmp_path / "b.usdz").read_bytes()


def test_what_does_not_fit_is_refused(clip):
    with pytest.raises(ReconstructError, match=r"profile 'pq-front' is not dense; profiles of method 'dense'"):
        reconstruct(clip, "dense", settings=quick(profile="pq-front"))
    with pytest.raises(ReconstructError, match=r"no network profile 'big'; have \['pa-front'"):
        reconstruct(clip, "dense", settings=quick(profile="big"))
    with pytest.raises(ReconstructError, match=r"takes 1 or 3 or 5 cameras, got 2"):
        reconstruct(clip, "dense", cameras=CAMERAS[:2], settings=quick())
    with pytest.raises(ReconstructError, match="method 'lift' takes LiftSettings, got FeedForwardSettings"):
        reconstruct(clip, "lift", settings=quick())
    with pytest.raises(ReconstructError, match="method 'dense' takes FeedForwardSettings, got LiftSettings"):
        reconstruct(clip, "dense", settings=LiftSettings())
    with pytest.raises(ReconstructError, match="cannot run the network on device 'quantum'"):
        reconstruct(clip, "dense", settings=quick(device="quantum"))
    with pytest.raises(ReconstructError, match=r"overlap must lie in 0..0.5, got 0.9"):
        quick(overlap=0.9)


def test_weights_that_are_not_there(clip, tmp_path):
    with pytest.raises(WeightsError, match=r"missing\.pth"):
        reconstruct(clip, "dense", settings=quick(random_weights=None, checkpoint=tmp_path / "missing.pth"))


def test_evaluation_takes_the_cameras_that_the_method_chose(clip):
    figures = evaluate(clip, "dense", via_grpc=False, settings=quick())
    assert figures["method"] == "dense"
    assert len(figures["input_cameras"]) in (1, 3)
    assert figures["image"]["psnr_db"] is not None
    assert set(figures["image"]["cameras"]) == set(figures["input_cameras"])
