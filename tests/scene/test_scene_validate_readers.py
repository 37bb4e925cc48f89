"""Archives of every kind that we write, opened by readers that do what AlpaSim's and CARLA's do."""

import dataclasses
import zipfile
from importlib import resources
from pathlib import Path

import foreign_files
import numpy as np
import ply_files
import pytest
import tiny_clip
from nurec_archives import IDS, archive, arrays
from scene_readers import InvalidSceneError, carla_project, read_artifact, read_carla, read_json
from scene_worlds import START_US, cameras, empty_scene, full_scene
from spoilt_archives import SIDECAR_BREAKS, complete_scene, members_of

from nurec_sim import geometry, logs, sensors
from nurec_sim.files.zip_package import write_package
from nurec_sim.reconstruct import reconstruct
from nurec_sim.reconstruct.lift.settings import LiftSettings, ViewSettings
from nurec_sim.scene import alpasim_id, import_scene, write_scene
from nurec_sim.scene.interop.validate import RULES, validate_archive
from nurec_sim.types import CameraModel, FTheta, FThetaReference, GaussianScene, Rig, Track, Trajectory

pytestmark = pytest.mark.usefixtures("quick_maps")


def with_cameras(*chosen: CameraModel, **changes) -> GaussianScene:
    """A scene with these cameras only, each with two frames."""
    frames = START_US + np.array([[100_000, 120_000], [200_000, 220_000]])
    rig = Rig({camera.id: camera for camera in chosen}, {})
    times = {camera.id: frames for camera in chosen}
    return dataclasses.replace(full_scene(), rig=rig, isp={}, camera_times_us=times, **changes)


def ftheta(**polynomials) -> CameraModel:
    reference = FThetaReference[next(iter(polynomials)).upper()]
    return dataclasses.replace(
        cameras()["rear"], lens=FTheta(640.25, 360.75, reference, max_angle_rad=1.2, **polynomials)
    )


def still(count: int) -> Track:
    pose = geometry.pose_from_xyyaw(20, -4, 0.3, 0.7)
    times = START_US + 100_000 * np.arange(count)
    return Track("still", "automobile", (4.5, 1.9, 1.6), Trajectory(times, np.repeat(pose[None], count, axis=0)))


def shifted(offset_us: int) -> GaussianScene:
    """The full scene at other times."""
    scene = full_scene()
    moved = [
        dataclasses.replace(t, path=Trajectory(t.path.t_us + offset_us, t.path.world_from_body)) for t in scene.tracks
    ]
    return dataclasses.replace(
        scene,
        ego=Trajectory(scene.ego.t_us + offset_us, scene.ego.world_from_body),
        tracks=moved,
        dynamic=dataclasses.replace(scene.dynamic, knot_t_us=scene.dynamic.knot_t_us + offset_us),
        span_us=(scene.span_us[0] + offset_us, scene.span_us[1] + offset_us),
        camera_times_us={name: times + offset_us for name, times in scene.camera_times_us.items()},
    )


SCENES = {
    "everything": full_scene,
    "distorted pinhole": lambda: with_cameras(cameras()["front"]),
    "fisheye": lambda: with_cameras(cameras()["left"]),
    "f-theta by distance": lambda: with_cameras(ftheta(pixeldist_to_angle=(0.0, 1 / 600, 0.0, 1e-11))),
    "f-theta by angle": lambda: with_cameras(ftheta(angle_to_pixeldist=(0.0, 600.0, 0.0, -3.0))),
    "no tracks": lambda: dataclasses.replace(full_scene(), tracks=[], dynamic=empty_scene().dynamic),
    "a track of one pose": lambda: dataclasses.replace(full_scene(), tracks=[*full_scene().tracks, still(1)]),
    "a standing track": lambda: dataclasses.replace(full_scene(), tracks=[*full_scene().tracks, still(30)]),
    "no map": lambda: dataclasses.replace(full_scene(), road_map=None),
    "no LiDAR": lambda: dataclasses.replace(full_scene(), rig=Rig(cameras(), {})),
    "starts at one second": lambda: shifted(1_000_000 - START_US),
    "epoch times": lambda: shifted(10**14),
    "no recorded frame": lambda: dataclasses.replace(full_scene(), camera_times_us={}),
    "frames beside the path": lambda: dataclasses.replace(
        full_scene(),
        camera_times_us={"front": START_US + np.array([[-50_000, -20_000], [9_000_000, 9_030_000]]),
                         "rear": START_US + np.array([[60_000, 70_000], [60_000, 70_000], [20_000, 50_000],
                                                   [-9, 1], [9_000, 40_000]])},
    ),
    "one pose": lambda: dataclasses.replace(full_scene(), ego=Trajectory(np.array([START_US]), np.eye(4)[None])),
}  # fmt: skip


def assert_complete(path: Path, scene: GaussianScene) -> None:
    """Both readers take the archive, and say what the scene says; the validator agrees with them."""
    no_map = ["map"] if scene.road_map is None else []
    assert [finding.rule for finding in validate_archive(path) if finding.severity == "error"] == no_map
    artifact = read_artifact(path)
    assert artifact.scene_id == f"clipgt-{scene.id}"
    assert artifact.camera_ids == list(scene.rig.cameras)
    assert set(artifact.actors) == {track.id for track in scene.tracks}
    assert [actor["is_static"] for actor in artifact.actors.values()] == [not t.controllable for t in scene.tracks]
    assert np.allclose(artifact.vehicle["size"], scene.rig.body.size_m)
    assert artifact.map_kind == ("map.xodr" if scene.road_map is not None else None)
    if scene.road_map is None:
        return
    client = read_carla(path, [artifact.scene_id])
    assert set(client["actors"]) == {track.id for track in scene.tracks if track.controllable}
    assert np.allclose(client["world_from_map"], np.eye(4), atol=1e-6)
    for name, spec in client["cameras"].items():
        camera = dataclasses.replace(scene.rig.cameras[name], windshield=None)
        assert spec["resolution"] == (camera.width_px, camera.height_px)
        corner = np.array([[camera.width_px * 0.9, camera.height_px * 0.9]])
        ray, seen = sensors.unproject(camera, corner)
        if seen.all():
            assert np.abs(carla_project(spec, ray[0]) - corner[0]).max() < 2.0


@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_readers_take_what_we_write(make, tmp_path):
    scene = make()
    assert_complete(write_scene(scene, tmp_path / "a.usdz"), scene)


def test_frames_beside_the_path_are_left_out(tmp_path):
    path = write_scene(SCENES["frames beside the path"](), tmp_path / "a.usdz")
    with zipfile.ZipFile(path) as package:
        frames = read_json(package, "rig_trajectories.json")["rig_trajectories"][0]["cameras_frame_timestamps_us"]
    first = [START_US + 20_000, START_US + 50_000]
    by_name = {uid.split("@")[0]: times for uid, times in frames.items()}
    assert by_name["rear"] == [first, [START_US + 60_000, START_US + 70_000]]
    assert all(by_name[name] == [first] for name in ("front", "left", "right", "roof"))


def test_a_car_with_one_pose_stands_for_the_whole_scene(tmp_path):
    scene = SCENES["one pose"]()
    path = write_scene(scene, tmp_path / "a.usdz")
    assert read_artifact(path).path_us.tolist() == [START_US, scene.span_us[1] - 1]
    assert read_carla(path, [alpasim_id(scene.id)])["span"] == (START_US, scene.span_us[1] - 1)


def test_the_fit_of_a_lens_says_how_good_it_is(tmp_path):
    path = write_scene(full_scene(), tmp_path / "a.usdz")
    with zipfile.ZipFile(path) as package:
        calibrations = read_json(package, "rig_trajectories.json")["camera_calibrations"].values()
    told = {camera["logical_sensor_name"]: camera.get("ftheta_fit_error_px") for camera in calibrations}
    assert told["rear"] is None  # an f-theta lens needs no fit
    client = read_carla(path, [alpasim_id(full_scene().id)])["cameras"]
    for name, camera in cameras().items():
        if told[name] is None:
            continue
        bare = dataclasses.replace(camera, windshield=None)
        uv = np.random.default_rng(0).uniform([0, 0], [camera.width_px, camera.height_px], (300, 2))
        rays, seen = sensors.unproject(bare, uv)
        off = [
            np.linalg.norm(carla_project(client[name], ray) - px) for ray, px in zip(rays[seen], uv[seen], strict=True)
        ]
        assert np.sqrt(np.mean(np.square(off))) == pytest.approx(told[name]["rms"], rel=0.5, abs=1e-3)
        assert max(off) <= told[name]["max"] * 1.1 + 1e-3
    assert 1.0 < told["front"]["max"] < 2.0 and told["left"]["max"] < 1e-3


def test_imported_scenes(tmp_path):
    ply = ply_files.standard(tmp_path / "garden.ply", ply_files.values(50))
    alone = import_scene(ply)
    assert_complete(write_scene(alone, tmp_path / "alone.usdz"), alone)
    beside = import_scene(ply, like=full_scene())
    assert_complete(write_scene(beside, tmp_path / "beside.usdz"), beside)


def test_an_import_closes_the_gaps_of_a_nurec_archive(tmp_path):
    theirs = archive(tmp_path / "theirs.usdz", {"volume.nurec": foreign_files.volume(arrays(), IDS)})
    broken = {finding.rule for finding in validate_archive(theirs) if finding.severity == "error"}
    assert {"metadata-file", "mesh-ground", "map", "camera-model"} <= broken
    scene = import_scene(theirs)
    assert_complete(write_scene(scene, tmp_path / "ours.usdz"), scene)


QUICK = LiftSettings(views=ViewSettings(width_px=96, max_views=2, max_frames=4, budget=20_000, levels=16), sky_px=16)


def test_a_lifted_clip(tmp_path):
    scene = reconstruct(logs.open_clip(tiny_clip.write(tmp_path / "clip")), "lift", settings=QUICK)
    assert_complete(write_scene(scene, tmp_path / "a.usdz"), scene)


@pytest.mark.slow
def test_the_demo_clip_lifted(tmp_path):
    clip = logs.open_clip(Path(str(resources.files("nurec_sim.scenarios"))) / "demo_clip.zip")
    scene = reconstruct(clip, "lift", cameras=("camera_front",), settings=QUICK)
    path = write_scene(scene, tmp_path / "demo.usdz")
    assert_complete(path, scene)
    assert validate_archive(path) == []


def test_the_readers_fail_where_theirs_do(tmp_path, monkeypatch):
    """Else the tests above would say nothing."""
    from nurec_sim.scene import sidecars

    good = sidecars._rig_trajectories
    breaks = {
        InvalidSceneError: lambda d: d["rig_trajectories"][0].update(rig_bbox=None),
        ValueError: lambda d: d["rig_trajectories"].append(d["rig_trajectories"][0]),
        KeyError: lambda d: d.pop("world_to_nre"),
        IndexError: lambda d: d["rig_trajectories"][0]["cameras_frame_timestamps_us"].update(
            {f"{name}@{full_scene().id}": [] for name in cameras()}
        ),
    }
    for error, spoil in breaks.items():

        def spoilt(scene, fits, spoil=spoil):
            document = good(scene, fits)
            spoil(document)
            return document

        monkeypatch.setattr(sidecars, "_rig_trajectories", spoilt)
        path = write_scene(full_scene(), tmp_path / "bad.usdz", overwrite=True)
        with pytest.raises(error):
            read_artifact(path)


EXCEPTIONS = {
    ("alpasim", "all frames too late"): False,
    ("alpasim", "a first frame at once"): False,
    ("alpasim", "one sample"): True,
}
"""Whether the reader fails where the severity says otherwise: other cameras' frames save the drive, a first frame at
once fails with the first image, and a spline through one sample may fail or not."""
READ_ELSEWHERE = {
    "alpasim": {"xodr", "xodr-lanes", "lane-under-path", "offroad-on-path", "offroad-agrees"},
    "carla": set(),
}
"""Rules on what the reader here leaves alone: ``scene.interop.validate.alpasim_map`` reads AlpaSim's map."""


READERS = {"alpasim": read_artifact, "carla": lambda path: read_carla(path, [alpasim_id(complete_scene().id)])}


@pytest.mark.parametrize("consumer, reader", READERS.items())
def test_the_validator_and_the_readers_agree_on_what_is_broken(consumer, reader, tmp_path):
    """An error is what a reader stumbles over, a warning is not: for every break that is tested elsewhere."""
    members, path = members_of(complete_scene(), tmp_path), tmp_path / "a.usdz"
    for name, (spoil, wanted) in SIDECAR_BREAKS.items():
        write_package(path, spoil(members))
        rules = {rule.split()[1] for rule in wanted if rule.startswith(f"{consumer} ")} - READ_ELSEWHERE[consumer]
        fatal = any(RULES[consumer][rule].severity == "error" for rule in rules)
        fatal = EXCEPTIONS.get((consumer, name), fatal)
        try:
            reader(path)
        except Exception as error:
            assert fatal, f"{name}: {error!r} is no error to the validator"
        else:
            assert not fatal, f"{name}: {rules} does not stop the reader"
