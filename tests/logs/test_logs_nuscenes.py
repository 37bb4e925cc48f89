"""nuScenes in its published layout: the demo log written so, and what ``nuscenes-devkit`` reads from it."""

import json
import shutil
from pathlib import Path

import numpy as np
import published_logs as published
import pytest

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.checks.calibration import check_calibration
from nurec_sim.logs.checks.sampling import sample_sweeps
from nurec_sim.logs.readers.nuscenes import NuScenesReader
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.store.recipes import content_key

LIDAR, EPOCH_US = published.LIDAR, published.EPOCH_NUSCENES_US
NAMES = {"CAM_FRONT": "camera_front", "CAM_FRONT_LEFT": "camera_front_left"}


@pytest.fixture(scope="module")
def demo() -> logs.Clip:
    return published.demo()


@pytest.fixture(scope="module")
def root(demo, tmp_path_factory) -> Path:
    return published.nuscenes(tmp_path_factory.mktemp("nuscenes"), demo)


@pytest.fixture(scope="module")
def clip(root) -> logs.Clip:
    return logs.open_clip(root / "scene-0007")


@pytest.mark.slow
def test_a_scene_keeps_the_contract(root):
    assert logs.check_reader(root / "scene-0007", NuScenesReader()) == []


def test_a_scene_is_what_was_recorded(clip, demo):
    assert (clip.id, clip.format, clip.facts["scene"]) == ("scene-0007", "nuscenes", "a {street}")
    moved = geometry.pose(np.eye(3), clip.ego.at(1 << 60)[:3, 3] - demo.ego.at(demo.sweep(LIDAR, 18).t_us)[:3, 3])
    assert np.allclose(moved[:3, 3], np.round(moved[:3, 3]), atol=1e-9)  # the world is the map, less whole metres
    assert np.abs(clip.ego.position_m[0]).max() < 1
    assert list(clip.rig.cameras) == list(NAMES) and list(clip.rig.lidars) == ["LIDAR_TOP"]
    wanted = list(published.INDICES)
    for name, other in NAMES.items():
        ours, theirs = clip.rig.cameras[name], demo.rig.cameras[other]
        assert np.allclose(ours.rig_from_camera, theirs.rig_from_camera, atol=1e-9)
        assert np.allclose([ours.lens.fx_px, ours.lens.cy_px], [theirs.lens.fx_px, theirs.lens.cy_px])
        assert (clip.camera_times_us(name) == demo.camera_times_us(other)[wanted] + EPOCH_US).all()
        assert np.allclose(clip.world_from_camera(name, 3), moved @ demo.world_from_camera(other, wanted[3]), atol=1e-6)
        assert np.abs(clip.image(name, 3).astype(float) - demo.image(other, wanted[3])).mean() < 3
    assert np.allclose(clip.rig.lidars["LIDAR_TOP"].rig_from_lidar, demo.rig.lidars[LIDAR].rig_from_lidar)
    for number in (0, 3):  # samples and the sweeps between them
        sweep, same = clip.sweep("LIDAR_TOP", number), demo.sweep(LIDAR, wanted[number])
        assert sweep.t_us == sweep.end_us == same.t_us + EPOCH_US and sweep.start_us == sweep.t_us - 50_000
        assert np.allclose(sweep.xyz_m, same.xyz_m, atol=1e-4) and np.allclose(sweep.intensity, same.intensity)
        assert np.allclose(sweep.world_from_lidar, moved @ same.world_from_lidar, atol=1e-6)


def test_annotations_become_tracks_that_are_interpolated(clip, demo):
    times = np.array([demo.sweep_records(LIDAR)[index].t_us for index in published.KEYFRAMES])
    shift = np.round(clip.ego.at(1 << 60)[:3, 3] - demo.ego.at(demo.sweep(LIDAR, 18).t_us)[:3, 3])
    for track, given in zip(clip.tracks, demo.tracks, strict=True):
        assert (track.label, track.size_m, track.controllable) == (given.label, given.size_m, True)
        assert (track.path.t_us == times + EPOCH_US).all()
        assert np.allclose(track.path.position_m - shift, given.path.at(times)[:, :3, 3], atol=1e-6)
        middle = (times[0] + times[1]) // 2
        mean = given.path.at(times[:2])[:, :3, 3].mean(axis=0)
        assert np.allclose(track.path.at(middle + EPOCH_US)[:3, 3] - shift, mean, atol=1e-3)


def test_a_scene_is_named_behind_the_folder_or_its_version(root):
    assert logs.open_clip(root / "v1.0-mini" / "scene-0007").id == "scene-0007"
    for path in (root, root / "v1.0-mini"):
        with pytest.raises(ClipError, match="name one behind the folder, as in .*/scene-0007: scene-0007, scene-0008"):
            logs.open_clip(path)
    with pytest.raises(ClipError, match="nuScenes has no scene 'scene-0009'; have scene-0007, scene-0008"):
        logs.open_clip(root / "scene-0009")
    with pytest.raises(ClipError, match="sample_data.json has no camera and no LiDAR of scene 'scene-0008'"):
        logs.open_clip(root / "scene-0008")
    with pytest.raises(ClipError, match="no clip at '.*nowhere/scene-0007'"):
        logs.open_clip(root / "nowhere" / "scene-0007")


def test_a_server_takes_a_scene_by_its_path(root):
    store = SceneStore([root / "scene-0007"])
    assert store.ids == ("clipgt-scene-0007",) and not store.faults
    assert content_key(root / "scene-0007", "lift") != content_key(root / "scene-0008", "lift")


def test_inverted_extrinsics_are_found(demo, tmp_path):
    clip = logs.open_clip(published.nuscenes(tmp_path, demo, invert=True) / "scene-0007")
    assert [len(row.faults) for row in check_calibration(clip, sample_sweeps(clip)[1:3])] == [1, 1]


def edit(table: list[dict], row: int, **values) -> list[dict]:
    table[row] = {key: value for key, value in {**table[row], **values}.items() if value is not None}
    return table


@pytest.mark.parametrize(
    "name, change, text",
    [
        ("sample_data", None, "no log reader knows this format|table sample_data.json is missing"),
        ("sensor", None, "table sensor.json is missing in v1.0-mini"),
        ("sensor", lambda t: {}, "sensor.json must hold a list of records, got dict"),
        ("calibrated_sensor", lambda t: t[1:], "sample_data.json: record '.*': calibrated_sensor.json has no record '"),
        ("calibrated_sensor", lambda t: edit(t, 0, rotation=[2, 0, 0, 0]), "the rotation is not a quaternion"),
        ("calibrated_sensor", lambda t: edit(t, 0, camera_intrinsic=[]), "'camera_intrinsic' must have the shape"),
        ("sample_data", lambda t: edit(t, 0, filename="../a.jpg"), "file name '../a.jpg' is not allowed"),
        ("sample_data", lambda t: edit(t, 0, timestamp="now"), "'timestamp' must be a whole number, got 'now'"),
        ("sample_data", lambda t: edit(t, 0, ego_pose_token="none"), "ego_pose.json has no record 'none'"),
        ("ego_pose", lambda t: edit(t, 3, translation=[1, 2]), "ego_pose.json: record .* must have the shape 3"),
        ("sample_annotation", lambda t: edit(t, 2, size=[1, 0, 1]), "record .*: size must be positive, got .1, 0, 1."),
        ("sample_annotation", lambda t: [*t, t[0]], "sample_annotation.json: instance '.*' has two boxes at one time"),
        ("instance", lambda t: t[1:], "sample_annotation.json: instance.json has no record '"),
        ("sample", lambda t: edit(t, 0, timestamp=None), "sample.json: 'timestamp' is missing; have "),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(root, tmp_path, name, change, text):
    shutil.copytree(root / "v1.0-mini", tmp_path / "v1.0-mini")
    file = tmp_path / "v1.0-mini" / f"{name}.json"
    if change is None:
        file.unlink()
    else:
        file.write_text(json.dumps(change(json.loads(file.read_text()))))
    with pytest.raises(ClipError, match=text):
        logs.open_clip(tmp_path / "scene-0007")


def test_damaged_tables_and_sweeps_are_named(root, tmp_path):
    shutil.copytree(root, tmp_path / "copy")
    table = tmp_path / "copy" / "v1.0-mini" / "sample_data.json"
    whole = table.read_text()
    table.write_text(whole.replace('"prev"', "prev"))
    with pytest.raises(ClipError, match="sample_data.json: the record around byte .* is not a JSON object"):
        logs.open_clip(tmp_path / "copy" / "scene-0007")
    table.write_text(whole)
    clip = logs.open_clip(tmp_path / "copy" / "scene-0007")
    file = tmp_path / "copy" / clip.sweep_records("LIDAR_TOP")[0].file
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(ClipError, match=r".pcd.bin must hold 20 bytes for each point, got \d+ bytes"):
        clip.sweep("LIDAR_TOP", 0)


def test_the_devkit_reads_the_same(root, clip):
    devkit = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")
    from nuscenes.utils.data_classes import LidarPointCloud

    theirs = devkit.NuScenes("v1.0-mini", str(root), verbose=False)
    sample = theirs.get("sample", theirs.scene[0]["first_sample_token"])
    origin = np.array(json.loads(clip.facts["world"].split("less ")[1].removesuffix(" m")))
    path, boxes, _ = theirs.get_sample_data(sample["data"]["LIDAR_TOP"])
    points = LidarPointCloud.from_file(path).points[:3].T
    sweep = clip.sweep("LIDAR_TOP", 0)
    quarter = geometry.inverse(published.FILE_FROM_LIDAR)
    assert np.allclose(geometry.transform_points(quarter, points), sweep.xyz_m, atol=1e-6)
    for box in boxes:  # in the frame of the LiDAR
        track = next(
            each for each in clip.tracks if each.id == theirs.get("sample_annotation", box.token)["instance_token"]
        )
        pose = geometry.inverse(sweep.world_from_lidar) @ track.path.at(sweep.t_us)
        assert np.allclose(pose[:3, 3], geometry.transform_points(quarter, box.center), atol=1e-6)
        assert track.size_m == pytest.approx(box.wlh[[1, 0, 2]])
    _, boxes, k = theirs.get_sample_data(sample["data"]["CAM_FRONT"])
    camera = clip.rig.cameras["CAM_FRONT"]
    pixel = camera.lens.project(boxes[0].center[None])[0][0]
    uvw = k @ boxes[0].center
    assert np.allclose(pixel, uvw[:2] / uvw[2] + 0.5)
    first = theirs.get("sample_data", sample["data"]["CAM_FRONT"])
    record = theirs.get("ego_pose", first["ego_pose_token"])
    rig = clip.world_from_camera("CAM_FRONT", 0)[0] @ geometry.inverse(camera.rig_from_camera)
    assert np.allclose(rig[:3, 3] + origin, record["translation"])
