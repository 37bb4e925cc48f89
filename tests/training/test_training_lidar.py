"""Training of the LiDAR branch: samples by hand, a run that resumes to the same bytes, recipes and their errors."""

import dataclasses

import numpy as np
import pytest
import torch

from nurec_sim import geometry
from nurec_sim.errors import TrainingError
from nurec_sim.network.checkpoints.fit import check_weights
from nurec_sim.network.lidar.branch import build_lidar
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.sensors import beam_directions
from nurec_sim.training.lidar.config import LidarTrainingConfig, is_lidar_recipe, read_lidar_config
from nurec_sim.training.lidar.objective import scan_loss
from nurec_sim.training.lidar.places import Scans, place_names, read_place, scanner
from nurec_sim.training.lidar.samples import scan_sample
from nurec_sim.training.lidar.trainer import WEIGHTS, LidarTrainer
from nurec_sim.types import Label

CONFIG = LidarTrainingConfig(
    steps=2, warm_up=1, checkpoint_every=1, log_every=1, data={"towns": 1, "places": 1, "targets": 1, "sector_deg": 40}
)
WALL_M = 12.0


def in_a_cylinder(shift_m: float) -> Scans:
    """Two sweeps in a round room, the second one from a place aside; a disc before the wall hides part of it."""
    lidar = scanner("VLP-16", np.eye(4))
    ray = beam_directions(lidar)
    poses = np.tile(np.eye(4), (2, 2, 1, 1))
    poses[1, :, 1, 3] = shift_m
    flat, ranges = ray[..., :2] / np.linalg.norm(ray[..., :2], axis=-1, keepdims=True), []
    for place in poses[:, 0, :2, 3]:
        along = flat @ place
        ranges.append((-along + np.sqrt(along**2 + WALL_M**2 - place @ place)) / np.linalg.norm(ray[..., :2], axis=-1))
    shape = (2, *ray.shape[:2])
    label = np.full(shape, Label.ROAD, np.uint8)
    intensity = np.full(shape, 0.3, np.float32)
    lost = np.zeros(shape, bool)
    return Scans(
        lidar, poses, np.stack(ranges).astype(np.float32), intensity, label, lost, np.zeros(shape[1:], np.float32)
    )


def save(scans: Scans, path) -> None:
    np.savez(
        path, device=np.array("VLP-16"), mount=np.eye(4), poses=scans.world_from_lidar, range_m=scans.range_m,
        intensity=scans.intensity.astype(np.float16), label=scans.label, lost=np.packbits(scans.lost, axis=-1),
        noise_m=scans.noise_m.astype(np.float16),
    )  # fmt: skip


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    folder = tmp_path_factory.mktemp("places")
    (name,) = place_names(CONFIG.data)
    save(in_a_cylinder(1.0), folder / name)
    return folder


def test_places_are_read_as_written(places):
    scans = read_place(places / place_names(CONFIG.data)[0])
    np.testing.assert_array_equal(scans.range_m, in_a_cylinder(1.0).range_m)
    (places / "damaged.npz").write_bytes(b"no")
    with pytest.raises(TrainingError, match="damaged.npz is damaged.*delete it, and it is generated again"):
        read_place(places / "damaged.npz")


def test_a_sample_sees_what_the_input_saw():
    scans = in_a_cylinder(0.5)
    sample = scan_sample(scans, CONFIG.data, np.random.default_rng(0))
    assert sample.range_m.shape == (16, 100) and sample.inputs.features.shape == (17, 16, 200)
    assert sample.seen.float().mean() > 0.85 and bool((sample.label == 1).all())
    nearer = dataclasses.replace(scans, range_m=scans.range_m * np.array([0.5, 1.0], np.float32)[:, None, None])
    assert not scan_sample(nearer, CONFIG.data, np.random.default_rng(0)).seen.any()


def test_the_loss_of_footprints_on_a_wall_is_small_and_has_gradients():
    sample = scan_sample(in_a_cylinder(0.5), CONFIG.data, np.random.default_rng(1))
    branch = build_lidar(LIDAR_PROFILES["lidar"]).train()
    total, terms = scan_loss(branch, sample, CONFIG.losses, threads=1)
    assert terms["range"] < 0.05 and terms["intensity"] < 1e-5 and terms["holes"] < 0.05
    assert terms["label"] == pytest.approx(np.log(3), rel=1e-5)
    total.backward()
    assert all(torch.isfinite(p.grad).all() for p in branch.parameters() if p.grad is not None)
    assert branch.head.weight.grad.abs().max() > 0
    # Rendered ray drop is that of the Gaussians.
    dropped = dataclasses.replace(sample, lost=torch.ones_like(sample.lost))
    assert scan_loss(branch, dropped, CONFIG.losses, threads=1)[1]["drop"] > 1 > terms["drop"]


def test_a_run_resumes_to_the_same_bytes(places, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    LidarTrainer(CONFIG, whole, places, threads=1).run()
    LidarTrainer(CONFIG, parts, places, threads=1).run(until=1)
    first = (parts / WEIGHTS).read_bytes()
    LidarTrainer(CONFIG, parts, places, threads=1).run()
    assert (whole / WEIGHTS).read_bytes() != first
    strip = [line.split(",")[4:] for line in (whole / "curves.csv").read_text().splitlines()]
    assert strip == [line.split(",")[4:] for line in (parts / "curves.csv").read_text().splitlines()]
    report = check_weights(whole / WEIGHTS, "lidar")
    assert not report.faults and ("steps", "2") in report.facts
    with pytest.raises(TrainingError, match="holds a run of another recipe"):
        LidarTrainer(CONFIG.without_floor(), whole, places)


def test_recipes_are_checked(tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("profile: lidar\nstepps: 3\n")
    assert is_lidar_recipe(recipe)
    with pytest.raises(TrainingError, match="stepps.*a recipe has the keys profile, seed, steps"):
        read_lidar_config(recipe)
    recipe.write_text("profile: tiny\n")
    assert not is_lidar_recipe(recipe) and not is_lidar_recipe(tmp_path / "none.yaml")
    assert CONFIG.without_floor().profile == "lidar-no-floor"
    with pytest.raises(TrainingError, match="has no twin without a scale floor"):
        CONFIG.without_floor().without_floor()


def test_the_sweep_moves_with_its_poses():
    scans = in_a_cylinder(0.0)
    moved = dataclasses.replace(
        scans, world_from_lidar=geometry.pose(np.eye(3), np.array([5.0, 0, 0])) @ scans.world_from_lidar
    )
    first, second = (scan_sample(each, CONFIG.data, np.random.default_rng(2)) for each in (scans, moved))
    torch.testing.assert_close(first.inputs.xyz_m, second.inputs.xyz_m, rtol=0, atol=1e-5)
    torch.testing.assert_close(first.poses, second.poses)
