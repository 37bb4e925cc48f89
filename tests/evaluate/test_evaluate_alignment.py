"""Scores of a log whose beams and poses are off: aligned before it is reconstructed and compared."""

import pytest
from misaligned import miscalibrated, shaken, street

from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate import evaluate, score_scene
from nurec_sim.logs.alignment import FACT, with_aligned_sweeps
from nurec_sim.logs.moved import corrected
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
from nurec_sim.types import Trajectory

CAMERA = "camera_front"
SMALL = LiftSettings(views=ViewSettings(width_px=160))


@pytest.fixture(scope="module")
def off():
    """A log whose beams are off by up to 0.1 degrees, and whose LiDAR pitches by 0.05 degrees."""
    return miscalibrated(street(8, CAMERA), 0.05)


@pytest.mark.slow
def test_held_out_sweeps_are_nearer_once_the_log_is_aligned(off):
    aligned, recorded = (
        evaluate(off, "lift", hold_out_sweeps_every=3, via_grpc=False, settings=SMALL, align_sweeps=each)
        for each in (True, False)
    )
    median = [each["lidar"]["by_surface"]["ground"]["median_perpendicular_m"] for each in (aligned, recorded)]
    assert median[0] < 0.75 * median[1]
    assert "reconstruct: aligning sweeps" in aligned["seconds"]


@pytest.mark.slow
def test_a_scene_of_an_aligned_log_is_compared_with_the_log_as_it_was_aligned(off):
    scene = reconstruct(shaken(off), "lift", settings=SMALL)
    assert FACT in scene.provenance
    figures = [
        score_scene(clip, scene, via_grpc=False)["image"]["psnr_db"]
        for clip in (shaken(off), with_aligned_sweeps(shaken(off)))
    ]
    assert figures[0] == pytest.approx(figures[1], abs=0.01)
    start = off.ego.at(off.ego.start_us)
    start[:3, 3] = [1.0, 0.0, 0.0]
    start[:3, :3] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    elsewhere = corrected(off, Trajectory(off.ego.t_us[:1], start[None]))
    with pytest.raises(ReconstructError, match="was not made from clip"):
        score_scene(elsewhere, scene, via_grpc=False)
