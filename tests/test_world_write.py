import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.world import LIDAR_ID, RoadLine, StreetPlan, backend, street_plan, street_rig, write_street_clip

DEMO = Path(__file__).parents[1] / "scenarios" / "demo_clip.zip"
RIG = street_rig(64, 48, lidar_rows=12, lidar_columns=60)


@pytest.fixture(scope="module")
def plan():
    return street_plan(5, seconds=1.0)


@pytest.fixture(scope="module")
def written(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("street")
    told = []
    path = write_street_clip(
        plan,
        folder / "clip.zip",
        rig=RIG,
        backend="rays",
        truth=folder / "truth",
        command="made so",
        progress=lambda stage, fraction: told.append((stage, fraction)),
    )
    return path, folder / "truth", told


def test_log_of_a_street_is_whole(plan, written):
    path, _, told = written
    clip = logs.open_clip(path)
    assert logs.check_clip(clip) == []
    assert list(clip.rig.cameras) == ["camera_front", "camera_front_left", "camera_front_right"]
    assert clip.sweep_count(LIDAR_ID) == clip.frame_count("camera_front") == 5
    assert (clip.facts["seed"], clip.facts["command"], clip.facts["seconds"]) == (5, "made so", 1.0)
    assert clip.ego.t_us.tolist() == plan.ego_trajectory().t_us.tolist()
    for found, expected in zip(clip.tracks, plan.tracks(), strict=True):
        assert (found.id, found.label, found.controllable) == (expected.id, expected.label, expected.controllable)
        np.testing.assert_allclose(found.size_m, expected.size_m, atol=1e-6)
        middle = clip.span_us[0] + 500_000
        np.testing.assert_allclose(found.path.at(middle), expected.path.at(middle), atol=1e-6)
    ring = RoadLine(plan.road).road_map().drivable[0][0]
    assert np.isclose(shapely.Polygon(clip.road_map.drivable[0][0]).area, shapely.Polygon(ring).area, rtol=1e-5)
    assert told[-1] == ("camera_front_right", 1.0) and len(told) == 20
    fractions = [fraction for _, fraction in told]
    assert fractions == sorted(fractions)


def test_sweeps_are_compensated_to_the_camera_time(written):
    clip = logs.open_clip(written[0])
    sweep = clip.sweep(LIDAR_ID, 3)
    assert sweep.t_us == clip.camera_times_us("camera_front")[3, 0] == (sweep.start_us + sweep.end_us) // 2
    assert sweep.point_t_us.min() >= sweep.start_us and sweep.point_t_us.max() <= sweep.end_us
    mount = clip.rig.lidars[LIDAR_ID].rig_from_lidar
    np.testing.assert_allclose(sweep.world_from_lidar, clip.ego.at(sweep.t_us) @ mount, atol=1e-9)
    assert np.linalg.norm(sweep.xyz_m, axis=1).max() <= 121
    z = sweep.xyz_world_m[:, 2]
    assert z.min() > -0.02 and np.mean(np.abs(z) < 0.02) > 0.2
    on_actors = 0
    for track in clip.tracks:
        inside_from_world = geometry.inverse(track.path.at(sweep.point_t_us))
        local = np.einsum("nij,nj->ni", inside_from_world[:, :3, :3], sweep.xyz_world_m) + inside_from_world[:, :3, 3]
        on_actors += geometry.points_in_box(local, track.size_m, 0.02).sum()
    assert on_actors > 15


def test_truth_lies_apart_from_the_log(plan, written):
    path, truth, _ = written
    assert StreetPlan.from_json((truth / "plan.json").read_text()) == plan
    with np.load(truth / "camera_front" / "0004.npz", allow_pickle=False) as arrays:
        assert arrays["depth_m"].shape == arrays["surface"].shape == arrays["instance"].shape == (48, 64)
        assert arrays["depth_m"].max() > 10
    names = subprocess.run(
        [sys.executable, "-m", "zipfile", "-l", path], capture_output=True, text=True, check=True
    ).stdout
    assert "depth" not in names and "plan" not in names


def test_same_plan_same_log_to_the_byte(plan, written, tmp_path):
    again = write_street_clip(plan, tmp_path / "clip.zip", rig=RIG, backend="rays", command="made so")
    assert again.read_bytes() == written[0].read_bytes()


def test_writing_over_things_is_refused(plan, written):
    path, truth, _ = written
    with pytest.raises(ClipError, match="exists"):
        write_street_clip(plan, path, rig=RIG, backend="rays")
    with pytest.raises(ClipError, match="truth' exists; choose another folder"):
        write_street_clip(plan, path, rig=RIG, backend="rays", truth=truth, overwrite=True)
    with pytest.raises(ClipError, match="a LiDAR turn takes 100000 us; period_us must not be less, got 50000"):
        write_street_clip(plan, path, rig=RIG, backend="rays", period_us=50_000, overwrite=True)


def test_too_small_rigs_are_refused():
    with pytest.raises(ValueError, match="at least 16 x 16 pixels.*got 8 x 256 and 48 x 600"):
        street_rig(8)


# ------------------------------------------------------------------------------------------------- drawing back ends


def fake(monkeypatch, broken):
    monkeypatch.setattr(backend, "why_not", lambda name: "it is missing" if name in broken else "")


def test_back_end_falls_back_in_order(monkeypatch):
    monkeypatch.delenv(backend.ENVIRONMENT, raising=False)
    for broken, picked in (((), "egl"), (("egl",), "osmesa"), (("egl", "osmesa"), "rays")):
        fake(monkeypatch, broken)
        assert backend.pick_backend() == picked


def test_environment_and_argument_choose_the_back_end(monkeypatch):
    fake(monkeypatch, ("egl",))
    monkeypatch.setenv(backend.ENVIRONMENT, "rays")
    assert backend.pick_backend() == "rays"
    assert backend.pick_backend("osmesa") == "osmesa"
    monkeypatch.setenv(backend.ENVIRONMENT, "egl")
    with pytest.raises(RuntimeError, match="'egl' does not work here: it is missing; 'rays' always does"):
        backend.pick_backend()
    monkeypatch.setenv(backend.ENVIRONMENT, "vulkan")
    with pytest.raises(ValueError, match="no drawing back end 'vulkan'; have egl, osmesa, rays .NUREC_SIM_GL sets it"):
        backend.pick_backend()


def test_trial_in_a_process_of_its_own_tells_why(monkeypatch):
    trial = backend.why_not.__wrapped__
    assert trial("rays") == ""
    monkeypatch.setattr(backend, "_PROBE", "raise OSError('no {name} on this machine')")
    assert trial("egl") == "OSError: no egl on this machine"
    monkeypatch.setattr(backend, "_PROBE", "import os; os.abort()")
    assert trial("egl").startswith("the trial ended with status -")
    monkeypatch.setattr(backend, "_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(backend, "PROBE_TIMEOUT_S", 0.5)
    assert trial("egl") == "no answer within 0.5 seconds"


def test_importing_the_package_loads_no_mujoco():
    code = "import sys, nurec_sim.world; assert 'mujoco' not in sys.modules; nurec_sim.world.street_plan(1)"
    code += "; assert 'mujoco' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---------------------------------------------------------------------------------------------------- the demo clip


def test_demo_clip_is_what_its_command_makes():
    clip = logs.open_clip(DEMO)
    assert DEMO.stat().st_size <= 8_000_000
    assert clip.facts["command"] == f"nurec-sim world --seed {clip.facts['seed']} --seconds 12 --out demo_clip.zip"
    plan = street_plan(clip.facts["seed"], clip.facts["seconds"])
    np.testing.assert_array_equal(clip.ego.t_us, plan.ego_trajectory().t_us)
    np.testing.assert_allclose(clip.ego.world_from_body, plan.ego_trajectory().world_from_body, atol=1e-6)
    assert [track.id for track in clip.tracks] == [track.id for track in plan.tracks()]
    assert clip.frame_count("camera_front") == clip.sweep_count(LIDAR_ID) == 60
    image = clip.image("camera_front", 30).astype(float)
    sky, road = image[2:20].mean(axis=(0, 1)), image[-20:].mean(axis=(0, 1))
    assert sky[2] > sky[0] + 15 and np.ptp(road) < 15
