import dataclasses
import json
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import shapely

from nurec_sim import cli, geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.types import Rig, Shutter
from nurec_sim.world import (
    LIDAR_ID,
    TownNetwork,
    TownPlan,
    random_responses,
    random_rig,
    street_rig,
    town_plan,
    write_town_clip,
)
from nurec_sim.world.sense import backend

DEMO = Path(__file__).parents[2] / "scenarios" / "demo_clip.zip"
STREET = street_rig(64, 48, lidar_rows=12, lidar_columns=60)
ROLLING = dataclasses.replace(
    random_rig(3, cameras=1, pixels=12544, lens="fisheye").cameras["camera_front"],
    id="camera_fisheye", shutter=Shutter.TOP_TO_BOTTOM,
)  # fmt: skip
RIG = Rig({"camera_front": STREET.cameras["camera_front"], ROLLING.id: ROLLING}, STREET.lidars)
OPTIONS = {"rig": RIG, "backend": "rays", "period_us": 500_000, "readout_us": 20_000, "command": "made so"}


@pytest.fixture(scope="module")
def plan():
    """Few actors and houses: drawing is not what these tests are about."""
    whole = town_plan(5, "test", "x_junction", seconds=1.2)
    return dataclasses.replace(whole, buildings=whole.buildings[:3], props=())


@pytest.fixture(scope="module")
def written(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("town")
    told = []
    path = write_town_clip(
        plan,
        folder / "clip.zip",
        truth=folder / "truth",
        responses=random_responses(RIG, 4),
        progress=lambda stage, fraction: told.append((stage, fraction)),
        **OPTIONS,
    )
    return path, folder / "truth", told


def test_log_of_a_town_is_whole(plan, written):
    path, _, told = written
    clip = logs.open_clip(path)
    assert logs.check_clip(clip) == []
    assert list(clip.rig.cameras) == ["camera_front", "camera_fisheye"]
    assert clip.rig.cameras[ROLLING.id].lens == ROLLING.lens
    assert clip.sweep_count(LIDAR_ID) == clip.frame_count("camera_front") == 3
    known = {key: clip.facts[key] for key in ("seed", "split", "template", "command", "seconds")}
    assert known == {
        "seed": 5, "split": "test", "template": "x_junction", "command": "made so", "seconds": 1.2
    }  # fmt: skip
    assert clip.ego.t_us.tolist() == plan.ego_trajectory().t_us.tolist()
    np.testing.assert_allclose(clip.ego.world_from_body, plan.ego_trajectory().world_from_body, atol=1e-9)
    for found, expected in zip(clip.tracks, plan.tracks(), strict=True):
        assert (found.id, found.label, found.controllable) == (expected.id, expected.label, expected.controllable)
        np.testing.assert_allclose(found.size_m, expected.size_m, atol=1e-6)
        middle = clip.span_us[0] + 500_000
        np.testing.assert_allclose(found.path.at(middle), expected.path.at(middle), atol=1e-6)
    area = shapely.union_all([shapely.Polygon(outer, holes) for outer, *holes in clip.road_map.drivable]).area
    assert np.isclose(area, TownNetwork(plan).surface.area, rtol=1e-6)
    assert told[-1] == ("camera_fisheye", 1.0) and len(told) == 9
    fractions = [fraction for _, fraction in told]
    assert fractions == sorted(fractions)


def test_rolling_shutters_say_where_they_were_at_both_ends(plan, written):
    clip = logs.open_clip(written[0])
    times, middle = clip.camera_times_us(ROLLING.id), clip.camera_times_us("camera_front")
    np.testing.assert_array_equal(times - middle, [[-10_000, 10_000]] * 3)
    ego = plan.ego_trajectory()
    for index, exposure in enumerate(times):
        expected = ego.at(exposure) @ ROLLING.rig_from_camera
        np.testing.assert_allclose(clip.world_from_camera(ROLLING.id, index), expected, atol=1e-9)


def test_sweeps_are_compensated_to_the_camera_time(plan, written):
    clip = logs.open_clip(written[0])
    sweep = clip.sweep(LIDAR_ID, 1)
    assert sweep.t_us == clip.camera_times_us("camera_front")[1, 0] == (sweep.start_us + sweep.end_us) // 2
    assert sweep.point_t_us.min() >= sweep.start_us and sweep.point_t_us.max() <= sweep.end_us
    mount = clip.rig.lidars[LIDAR_ID].rig_from_lidar
    np.testing.assert_allclose(sweep.world_from_lidar, clip.ego.at(sweep.t_us) @ mount, atol=1e-9)
    assert np.linalg.norm(sweep.xyz_m, axis=1).max() <= 121
    above = sweep.xyz_world_m[:, 2] - TownNetwork(plan).height_m(sweep.xyz_world_m[:, :2])
    assert above.min() > -0.15 and np.mean(np.abs(above) < 0.1) > 0.2
    on_actors = 0
    for track in clip.tracks:
        inside_from_world = geometry.inverse(track.path.at(sweep.point_t_us))
        local = np.einsum("nij,nj->ni", inside_from_world[:, :3, :3], sweep.xyz_world_m) + inside_from_world[:, :3, 3]
        on_actors += geometry.points_in_box(local, track.size_m, 0.1).sum()
    assert on_actors > 15


def test_truth_lies_apart_from_the_log(plan, written):
    path, truth, _ = written
    assert TownPlan.from_json((truth / "plan.json").read_text()) == plan
    responses = json.loads((truth / "responses.json").read_text())
    assert set(responses) == {"camera_front", "camera_fisheye", LIDAR_ID}
    assert responses["camera_front"]["exposure"] != responses["camera_fisheye"]["exposure"]
    assert sorted(file.name for file in (truth / "camera_front").iterdir()) == ["0000.npz", "0001.npz", "0002.npz"]
    with np.load(truth / "camera_front" / "0001.npz", allow_pickle=False) as arrays:
        assert {name: array.shape for name, array in arrays.items()} == {
            "depth_m": (48, 64), "surface": (48, 64), "instance": (48, 64), "normal": (48, 64, 3),
            "flow_m": (48, 64, 3),
        }  # fmt: skip
        assert arrays["depth_m"].max() > 10
        assert (arrays["flow_m"][arrays["instance"] == 0] == 0).all()
        length = np.linalg.norm(arrays["normal"].astype(float), axis=2)
        assert np.mean(np.abs(length[arrays["depth_m"] > 0] - 1) < 0.01) > 0.9
    log = logs.open_clip(path)
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if not name.startswith(("images/", "lidar/"))]
        assert b"<OpenDRIVE>" in archive.read("map.xodr")
    assert sorted(names) == ["calib.json", "frames.json", "map.json", "map.xodr", "meta.json", "tracks.json"]
    assert "exposure" not in json.dumps(dict(log.facts))


@pytest.mark.slow
def test_same_plan_same_log_to_the_byte(plan, written, tmp_path):
    again = write_town_clip(plan, tmp_path / "clip.zip", responses=random_responses(RIG, 4), **OPTIONS)
    assert again.read_bytes() == written[0].read_bytes()


def test_an_interrupted_drive_leaves_nothing(plan, tmp_path):
    def stop(stage, fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_town_clip(plan, tmp_path / "clip.zip", truth=tmp_path / "truth", progress=stop, **OPTIONS)
    assert list(tmp_path.iterdir()) == []


def test_writing_over_things_is_refused(plan, written):
    path, truth, _ = written
    before = sorted(file.name for file in path.parent.iterdir())
    with pytest.raises(ClipError, match="clip.zip' exists; choose another path or allow overwriting"):
        write_town_clip(plan, path, **OPTIONS)
    with pytest.raises(ClipError, match="truth' exists; choose another folder"):
        write_town_clip(plan, path, truth=truth, overwrite=True, **OPTIONS)
    for change, text in (
        ({"period_us": 50_000}, r"period_us must be 100000 or more \(a LiDAR turn, or two readouts\), got 50000"),
        ({"readout_us": 200_000}, "readout_us must be within 0..100000, got 200000"),
    ):
        with pytest.raises(ClipError, match=text):
            write_town_clip(plan, path, overwrite=True, **{**OPTIONS, **change})
    with pytest.raises(ClipError, match="the plan has no ego: nobody drives"):
        write_town_clip(dataclasses.replace(plan, ego=()), path, overwrite=True, **OPTIONS)
    assert sorted(file.name for file in path.parent.iterdir()) == before


@pytest.mark.parametrize("name", ["meta.json", "../map.xodr", "a/b", ""])
def test_attachments_need_names_of_their_own(plan, tmp_path, name):
    with pytest.raises(ClipError, match="needs a plain file name that the clip does not use itself"):
        logs.write_clip(
            tmp_path / "clip", id="x", rig=Rig({}, {}), ego=plan.ego_trajectory(), frames=(), attachments={name: b""}
        )
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------------------------------------- command line


@pytest.mark.slow
def test_the_verb_draws_a_plan_with_the_car_that_was_asked_for(plan, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(backend.ENVIRONMENT, "rays")
    (tmp_path / "plan.json").write_text(plan.to_json())
    order = ["world", "--plan", str(tmp_path / "plan.json"), "--out", str(tmp_path / "made"), "--hz", "1"]
    cli.main([*order, "--cameras", "3", "--lens", "ftheta", "--pixels", "12544", "--lidar", "none"])
    clip = logs.open_clip(tmp_path / "made")
    assert logs.check_clip(clip) == [] and list(clip.rig.lidars) == []
    assert list(clip.rig.cameras) == ["camera_front", "camera_front_left", "camera_front_right"]
    # Not where to: the same log has the same bytes.
    order = "nurec-sim world --plan plan.json --hz 1 --cameras 3 --lens ftheta --pixels 12544 --lidar none"
    assert clip.facts["command"] == order
    assert (tmp_path / "made" / "map.xodr").is_file() and "x_junction" in capsys.readouterr().out


def test_the_verb_draws_the_usual_cameras_in_the_size_and_quality_that_were_asked_for(tmp_path, monkeypatch):
    monkeypatch.setenv(backend.ENVIRONMENT, "rays")
    order = ["--seed", "3", "--split", "train", "--template", "straight", "--seconds", "1", "--traffic", "dense"]
    order += ["--hz", "1"]
    sizes = {}
    for quality in ("30", "95"):
        words = [*order, "--jpeg-quality", quality, "--width", "96", "--height", "64"]
        cli.main(["world", *words, "--out", str(tmp_path / quality)])
        clip = logs.open_clip(tmp_path / quality)
        assert clip.facts["command"] == " ".join(["nurec-sim world", *words])
        assert clip.image("camera_front", 0).shape == (64, 96, 3)
        sizes[quality] = sum(path.stat().st_size for path in (tmp_path / quality).rglob("*.jpg"))
    assert sizes["30"] < 0.6 * sizes["95"]


@pytest.mark.parametrize(
    "words, text",
    [
        (["--seed", "-2"], "a town needs a seed >= 0"),
        (["--seconds", "0.5"], "1..30 seconds"),
        (["--template", "roundabout"], "no template 'roundabout' in split 'train'; have straight"),
        (["--seconds", "1", "--hz", "30"], "--hz must be within 0.1..25, got 30"),
        (["--seconds", "1", "--lidar", "HDL"], "no LiDAR 'HDL'; have"),
        (["--seconds", "1", "--jpeg-quality", "0"], "--jpeg-quality must be within 1..100, got 0"),
        (["--seconds", "1", "--width", "8"], "at least 16 x 16 pixels"),
        (["--seconds", "1", "--width", "640", "--cameras", "1"], "give --pixels for a random one"),
        (["--seconds", "1", "--template", "straight", "--turn", "left"], "goes left at its first junction"),
        (["--plan", "there.json", "--turn", "left"], "--plan defines the town; remove --turn"),
        (["--plan", "there.json", "--seed", "3"], "--plan defines the town; remove --seed"),
        (["--plan", "nowhere.json"], "cannot read the plan nowhere.json"),
        (["--plan", "there.json"], "there.json: not a town plan: the text itself"),
    ],
)
def test_impossible_orders_are_refused_with_a_reason(words, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("there.json").write_text("{")
    with pytest.raises(SystemExit) as ended:
        cli.main(["world", "--out", "made.zip", *words])
    assert ended.value.code == 1 and text in " ".join(capsys.readouterr().err.split())
    assert [file.name for file in tmp_path.iterdir()] == ["there.json"]


def test_too_small_rigs_are_refused():
    with pytest.raises(ValueError, match="at least 16 x 16 pixels.*got 8 x 256 and 48 x 600"):
        street_rig(8)


# ------------------------------------------------------------------------------------------------- rendering back ends


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
    with pytest.raises(ValueError, match="no rendering back end 'vulkan'; have egl, osmesa, rays .NUREC_SIM_GL sets"):
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
    code = "import sys, nurec_sim.world; assert 'mujoco' not in sys.modules; nurec_sim.world.town_plan(1)"
    code += "; assert 'mujoco' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---------------------------------------------------------------------------------------------------- the demo clip


def test_demo_clip_is_what_its_description_says():
    """A busy junction, a right turn, and people: docs/world.md."""
    clip = logs.open_clip(DEMO)
    assert DEMO.stat().st_size <= 7_100_000 and logs.check_clip(clip) == []
    assert clip.facts["command"] == (
        "nurec-sim world --seed 22 --split test --template t_junction --seconds 10 --traffic dense --turn right"
        " --hz 4 --jpeg-quality 75 --width 640 --height 400"
    )
    assert clip.span_us[0] == 1_000_000 and clip.ego.t_us[-1] == 11_000_000
    assert {(camera.width_px, camera.height_px) for camera in clip.rig.cameras.values()} == {(640, 400)}
    assert {clip.frame_count(name) for name in clip.rig.cameras} == {clip.sweep_count(LIDAR_ID)} == {40}
    steps = np.diff(clip.ego.position_m[:, :2], axis=0)
    speed = np.linalg.norm(steps, axis=1) / np.diff(clip.ego.t_us * 1e-6)
    assert 3.0 <= speed.min() and speed.max() <= 6.0 and 44 <= np.linalg.norm(steps, axis=1).sum() <= 46
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    assert np.degrees(heading[-1] - heading[0]) == pytest.approx(-76, abs=1)  # to the right
    turning_s = clip.ego.t_us[1:][np.abs(heading - heading[0]) > np.radians(5)][0] / 1e6
    assert turning_s == pytest.approx(5.3, abs=0.2)
    road = shapely.Polygon(clip.road_map.drivable[0][0], clip.road_map.drivable[0][1:])
    assert shapely.contains_xy(road, *clip.ego.position_m[:, :2].T).all()
    ahead = clip.ego.position_m[0, :2] + 45 * steps[0] / np.linalg.norm(steps[0])
    assert shapely.contains(road, shapely.LineString([clip.ego.position_m[0, :2], ahead]))  # straight on is road, too
    assert Counter((track.label, track.controllable) for track in clip.tracks) == {
        ("automobile", True): 24, ("automobile", False): 25, ("person", True): 11, ("person", False): 3,
    }  # fmt: skip


def test_people_of_the_demo_clip_are_seen_and_one_crosses_behind_the_car():
    clip = logs.open_clip(DEMO)
    road = shapely.Polygon(clip.road_map.drivable[0][0], clip.road_map.drivable[0][1:])
    people = [track for track in clip.tracks if track.label == "person"]
    near = {
        track.id
        for track in people
        for t_us in track.path.t_us[::5]
        if np.linalg.norm(track.path.at(t_us)[:2, 3] - clip.ego.at(t_us)[:2, 3]) < 15
    }
    assert len(near) >= 6
    walker = next(track for track in people if track.id == "pedestrian_0").path
    crossing = walker.t_us[shapely.contains_xy(road, *walker.position_m[:, :2].T)]
    line = shapely.LineString(clip.ego.position_m[:, :2])
    met = np.array([line.project(shapely.Point(walker.at(t)[:2, 3])) for t in crossing])
    driven = np.array([line.project(shapely.Point(clip.ego.at(t)[:2, 3])) for t in crossing])
    assert shapely.LineString(walker.position_m[:, :2]).crosses(line)
    assert len(crossing) > 10 and (driven - met).min() > 10  # the rear axle is well past where they walk
