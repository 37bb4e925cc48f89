import json
import os
from pathlib import Path

import numpy as np
import pytest
from reconstruct_street import Street, camera
from repetition import slow_after

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate import evaluate, log
from nurec_sim.evaluate.scores.lidar import LidarScore, scanner_along, score_sweep
from nurec_sim.logs import HeldOut, as_fired, hold_out
from nurec_sim.reconstruct import LiftSettings, ViewSettings
from nurec_sim.types import LidarFrame, RoadMap

SMALL = LiftSettings(sky_px=32, views=ViewSettings(levels=32))


def street():
    return Street(frames=5, cameras=(camera("left", 0.25), camera("right", -0.25)))


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    result = evaluate(street(), input_cameras=["left"], target_cameras=["right"], hold_out_sweeps_every=2,
                      images_dir=folder, via_grpc=False, settings=SMALL)  # fmt: skip
    return result, folder


def test_figures_are_json_and_better_than_copying(figures):
    result, _ = figures
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    right = result["image"]["cameras"]["right"]
    assert len(right["per_frame"]["psnr_db"]) == 5 and not right["input"]
    assert right["psnr_db"] > right["floor"]["psnr_db"] + 2
    assert right["ssim"] > right["floor"]["ssim"]
    assert result["image"]["psnr_db"] == pytest.approx(np.mean(right["per_frame"]["psnr_db"]))


def test_held_out_sweeps_are_simulated(figures):
    lidar = figures[0]["lidar"]
    assert figures[0]["held_out_sweeps"] == [2, 4]
    assert [row["sweep"] for row in lidar["per_sweep"]] == [2, 4]
    assert lidar["median_abs_range_error_m"] < 0.05 and lidar["return_recall"] > 0.95


def test_pairs_of_images_are_written(figures):
    import cv2

    picture = cv2.imread(str(figures[1] / "right_0003.png"))
    assert picture.shape == (192, 192, 3)
    assert np.array_equal(picture[:96, :, ::-1], street().image("right", 3))


@pytest.mark.slow
def test_over_grpc_the_figures_are_the_same(figures):
    over = evaluate(street(), input_cameras=["left"], target_cameras=["right"], hold_out_sweeps_every=2, settings=SMALL)
    assert over["via"] == "grpc"
    assert over["image"] == figures[0]["image"]
    assert over["lidar"] == figures[0]["lidar"]


@pytest.mark.slow
@pytest.mark.parametrize("half_width_m, agrees", slow_after(1, [(1.2, False), (4.0, True)]))
def test_road_is_scored_against_the_map_of_the_log(half_width_m, agrees):
    ring = np.array([[-40, -half_width_m], [60, -half_width_m], [60, half_width_m], [-40, half_width_m]])
    clip = Street(frames=5, road_map=RoadMap(((ring,),)))
    road = evaluate(clip, via_grpc=False, settings=SMALL)["road"]
    assert road["known"] > 100
    assert (road["agreement"] >= 0.95) == agrees


@pytest.mark.slow
def test_road_is_not_scored_without_a_map_or_a_drive(figures):
    assert figures[0]["road"] is None
    ring = np.array([[-40.0, -4], [60, -4], [60, 4], [-40, 4]])
    standing = Street(frames=2, speed_mps=0.0, road_map=RoadMap(((ring,),)))
    assert "not_known" in evaluate(standing, via_grpc=False, settings=SMALL)["road"]


def test_which_sweeps_are_held_out():
    assert hold_out(street(), [], sweeps_every=2).sweeps == {2, 4}
    assert hold_out(street(), [], sweeps=[3, 1]).sweeps == {1, 3}
    assert hold_out(street(), ["left"]) == HeldOut()
    with pytest.raises(ReconstructError, match="sweeps_every must be 0 .none. or at least 2, got -1"):
        evaluate(street(), hold_out_sweeps_every=-1)
    with pytest.raises(ReconstructError, match=r"no camera \['up'\]; have \['left', 'right'\]"):
        evaluate(street(), target_cameras=["up"])


def test_the_reconstruction_never_gets_what_is_held_out(monkeypatch):
    class AskedError(Exception):
        pass

    def asked(clip, method, *, cameras, hold_out_sweeps, progress, align_sweeps):
        raise AskedError(len(clip.camera_times_us("left")), hold_out_sweeps)

    monkeypatch.setattr("nurec_sim.reconstruct.reconstruct", asked)
    with pytest.raises(AskedError) as caught:
        evaluate(street(), input_cameras=["left"], hold_out_every=2, hold_out_sweeps=[0])
    held = hold_out(street(), ["left"], images_every=2, sweeps=[0])
    assert held.images == {"left": {1, 3}} and len(held.sweeps) > 1
    assert caught.value.args == (3, sorted(held.sweeps))


def test_score_of_a_perfect_and_of_a_short_sweep():
    clip = street()
    fired, poses = as_fired(clip, "top", clip.sweep("top", 1))
    scanner = scanner_along(clip.rig.lidars["top"], fired)
    from nurec_sim import sensors

    directions = sensors.beam_directions(scanner)
    world = directions.reshape(-1, 3) @ poses[0][:3, :3].T
    distance, _ = clip.cast(poses[0][:3, 3], world, 1)
    beam = np.flatnonzero(distance < 60).astype(np.int32)

    def frame(scale, beams):
        reach = (distance[beams] * scale).astype(np.float32)
        return LidarFrame(scanner, 0, 1, np.zeros((len(beams), 3), np.float32), reach, np.zeros_like(reach), beams)

    perfect = score_sweep(frame(1.0, beam), fired)
    assert perfect.recall > 0.99 and perfect.median_abs_error_m < 0.02
    short = score_sweep(frame(0.9, beam), fired)
    recorded = np.median(np.linalg.norm(fired, axis=1))
    assert short.median_abs_error_m == pytest.approx(0.1 * recorded, rel=0.1)
    columns = len(scanner.azimuth_rad)
    half = score_sweep(frame(1.0, beam[beam % columns < columns // 2]), fired)
    assert 0.4 < half.recall < 0.6
    nothing = score_sweep(frame(1.0, beam[:0]), fired)
    assert nothing.recall == 0 and np.isnan(nothing.median_abs_error_m)


def test_pooling_weighs_beams():
    pooled = LidarScore.pooled(
        [
            LidarScore(np.array([[5.0, 0, 0]] * 3), np.array([4.0, np.nan, np.nan])),
            LidarScore(np.array([[0, 5.0, 0]]), np.array([8.0])),
        ]
    )
    assert pooled.recall == 0.5 and pooled.median_abs_error_m == 2.0


def test_returns_in_the_frame_of_their_firing():
    clip = street()
    sweep = clip.sweep("top", 1)
    fired, poses = as_fired(clip, "top", sweep)
    assert np.allclose(fired, sweep.xyz_m, atol=1e-9)
    assert np.allclose(poses[0], sweep.world_from_lidar)
    assert geometry.is_rotation(poses[1][:3, :3])


REAL = Path(os.environ.get("NUREC_SIM_REALDATA", Path(__file__).parents[3] / "shared" / "realdata")) / "kitti_raw_0002"


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real data at {REAL.name}")
def test_real_stereo_is_better_than_copying():
    from nurec_sim.logs import open_clip

    result = evaluate(open_clip(REAL), input_cameras=["cam_left"], target_cameras=["cam_right"], hold_out_sweeps=[5],
                      via_grpc=False)  # fmt: skip
    right = result["image"]["cameras"]["cam_right"]
    assert right["psnr_db"] > right["floor"]["psnr_db"] + 1.0
    assert result["lidar"]["median_abs_range_error_m"] < 0.2
    assert result["lidar"]["return_recall"] > 0.85


def test_time_is_added_up_by_stage_whatever_a_stage_tells_of_itself():
    told = []
    clock = log._StageClock(lambda stage, fraction: told.append(stage))
    for text in ("images", "fitting, 1 images", "fitting, 2 images"):
        clock(text, 0.5)
    clock.stop()
    assert list(clock.seconds) == ["start", "images", "fitting"] and told[-1] == "fitting, 2 images"
