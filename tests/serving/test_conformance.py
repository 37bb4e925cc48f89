"""The conformance kit passes our server, and finds the rule that a broken one breaks."""

import itertools
import json

import cv2
import numpy as np
import pytest
from serving_calls import street_server
from serving_world import LAST_US

from nurec_sim import cli, geometry
from nurec_sim.errors import OutOfRangeError, RequestError, UnsupportedError
from nurec_sim.serving import wire
from nurec_sim.serving.conformance import CHECKS, Target, Verdict, run_checks
from nurec_sim.serving.conformance.target import CONNECT_S
from nurec_sim.serving.sensor_service import SensorService
from nurec_sim.serving.wire import ImageFormat


@pytest.fixture
def masks(tmp_path):
    mask = np.zeros((90, 160, 4), np.uint8)
    mask[60:] = (20, 10, 5, 255)
    (tmp_path / "hyperion_8_1").mkdir()
    cv2.imwrite(str(tmp_path / "hyperion_8_1" / "front.png"), mask)
    return tmp_path


def test_our_server_keeps_every_rule(masks):
    with street_server(ego_mask_dir=masks) as address, Target(address, allow_changes=True) as target:
        outcomes = list(run_checks(target))
    assert len(outcomes) == len(CHECKS) > 60
    assert {o.name: o.text for o in outcomes if o.verdict != Verdict.PASS} == {}


@pytest.mark.parametrize(("only_listed", "rule"), [(False, "stay as recorded"), (True, "are not drawn")])
def test_either_rule_for_unlisted_actors_is_allowed(only_listed, rule):
    names = [name for name in CHECKS if name.startswith("actors-")]
    with street_server(only_listed_actors=only_listed) as address, Target(address) as target:
        outcomes = {o.name: o for o in run_checks(target, names)}
    assert {o.verdict for o in outcomes.values()} == {Verdict.PASS}
    assert outcomes["actors-unlisted"].text == f"unlisted actors {rule}"


# ------------------------------------------------------------------------------------------------------ broken servers


def before(name, change):
    """The procedure answers a changed request; ``change`` may raise."""
    original = getattr(SensorService, name)

    async def broken(self, request):
        change(request)
        return await original(self, request)

    return {name: broken}


def after(name, change):
    """The procedure's answer is changed."""
    original = getattr(SensorService, name)

    async def broken(self, request):
        reply = await original(self, request)
        change(request, reply)
        return reply

    return {name: broken}


def raising(error, when=lambda request: True):
    def change(request):
        if when(request):
            raise error

    return change


def set_if(when, **values):
    def change(request):
        if when(request):
            for name, value in values.items():
                setattr(request, name, value)

    return change


def only_valid_batches(batch):
    for item in batch.items:
        if item.request.frame_start_us == item.request.frame_end_us:
            raise RequestError("an item is wrong")


def start_pose_for_both(request):
    request.sensor_pose.end_pose.CopyFrom(request.sensor_pose.start_pose)


def crop(request):
    spec = request.camera_intrinsics
    spec.resolution_h, spec.resolution_w = request.resolution_h, request.resolution_w


def drop_polynomial(_, reply):
    for camera in reply.available_cameras:
        camera.intrinsics.ftheta_param.ClearField("pixeldist_to_angle_poly")


def in_start_frame(request, reply):
    pair = request.sensor_pose
    start, end = wire.read_poses([pair.start_pose, pair.end_pose], ["start", "end"])
    points = np.frombuffer(reply.point_xyzs_buffer, "<f4").reshape(-1, 3)
    reply.point_xyzs_buffer = geometry.transform_points(geometry.inverse(start) @ end, points).astype("<f4").tobytes()


def interleaved(request, reply):
    if request.image_format == ImageFormat.RGB_UINT8_PLANAR:
        planes = np.frombuffer(reply.image_bytes, np.uint8).reshape(3, request.resolution_h, request.resolution_w)
        reply.image_bytes = np.ascontiguousarray(np.moveaxis(planes, 0, 2)).tobytes()


def intensities_to_255(_, reply):
    reply.point_intensities_buffer = (np.frombuffer(reply.point_intensities_buffer, "<f4") * 255).tobytes()


def origin_for_nan(request):
    if np.isnan(request.sensor_pose.start_pose.vec.x):
        request.sensor_pose.start_pose.vec.x = 0


def normalised(request):
    for pose in (request.sensor_pose.start_pose, request.sensor_pose.end_pose):
        quat = np.array([pose.quat.w, pose.quat.x, pose.quat.y, pose.quat.z])
        pose.quat.w, pose.quat.x, pose.quat.y, pose.quat.z = (quat / np.linalg.norm(quat)).tolist()


def lacks_forward(request):
    lens = request.camera_intrinsics.ftheta_param
    return request.camera_intrinsics.HasField("ftheta_param") and not lens.angle_to_pixeldist_poly


def repeat_time(_, reply):
    poses = reply.available_trajectories[0].trajectory.poses
    poses[1].timestamp_us = poses[0].timestamp_us


def other_id(_, reply):
    reply.available_cameras[0].intrinsics.logical_id = "another"


def black_when_listed(request, reply):
    if request.dynamic_objects:
        width, height = request.resolution_w, request.resolution_h
        reply.image_bytes = cv2.imencode(".png", np.zeros((height, width, 3), np.uint8))[1].tobytes()


def long_quaternions(_, reply):
    for camera in reply.available_cameras:
        camera.rig_to_camera.quat.w *= 1.01
        camera.rig_to_camera.ClearField("exact")


def count_up(_, reply):
    reply.image_bytes += bytes([next(COUNTER)])


def threshold_as_count(request, reply):
    reply.num_points = round(request.render_filter.opacity_threshold)


COUNTER = itertools.count()
AFTER_THE_END = set_if(lambda r: r.frame_start_us > LAST_US, frame_start_us=LAST_US, frame_end_us=LAST_US + 1)
BROKEN = {
    "time-last-instant": before("render_rgb", raising(OutOfRangeError("late"), lambda r: r.frame_end_us > LAST_US)),
    "time-after": before("render_rgb", AFTER_THE_END),
    "time-empty": before("render_rgb", lambda r: setattr(r, "frame_end_us", r.frame_end_us + 1)),
    "scene-unknown": before("get_available_cameras", raising(ValueError("no"), lambda r: "no-such" in r.scene_id)),
    "scenes-listed": after("get_available_scenes", lambda _, r: r.scene_ids.append(r.scene_ids[0])),
    "cameras-listed": after("get_available_cameras", other_id),
    "camera-mountings": after("get_available_cameras", long_quaternions),
    "ftheta-both-polynomials": after("get_available_cameras", drop_polynomial),
    "trajectory": after("get_available_trajectories", repeat_time),
    "version": after("get_version", lambda _, r: setattr(r, "version_id", f"{next(COUNTER)}")),
    "loaded-scenes": after("get_loaded_scenes", lambda _, r: r.ClearField("scenes")),
    "rgb-planar": after("render_rgb", interleaved),
    "jpeg-quality": before("render_rgb", set_if(lambda r: True, image_quality=95)),
    "format-unknown": before("render_rgb", set_if(lambda r: r.image_format == 77, image_format=1)),
    "deterministic": after("render_rgb", count_up),
    "size-from-aspect": before("render_rgb", set_if(lambda r: r.resolution_w <= 1, resolution_w=2)),
    "size-keeps-view": before("render_rgb", crop),
    "lens-ftheta-one-polynomial": before("render_rgb", raising(RequestError("both, please"), lacks_forward)),
    "lens-windshield": before(
        "render_rgb", lambda r: r.camera_intrinsics.ClearField("bivariate_windshield_model_param")
    ),
    "shutter-rolling": before("render_rgb", start_pose_for_both),
    "shutter-global": before("render_rgb", lambda r: setattr(r.camera_intrinsics, "shutter_type", 1)),
    "pose-not-finite": before("render_rgb", origin_for_nan),
    "pose-not-rigid": before("render_rgb", normalised),
    "batch-names": after("batch_render_rgb", lambda _, r: r.items.pop() if r.items else None),
    "batch-item-error": before("batch_render_rgb", only_valid_batches),
    "batch-equals-single": before("render_rgb", set_if(lambda r: True, resolution_h=45)),
    "actors-underground": before("render_rgb", lambda r: r.ClearField("dynamic_objects")),
    "actors-unknown-id": before(
        "render_rgb", raising(RequestError("who?"), lambda r: any("no-such" in d.track_id for d in r.dynamic_objects))
    ),
    "actors-unlisted": after("render_rgb", black_when_listed),
    "lidar-buffers": after("render_lidar", intensities_to_255),
    "lidar-end-frame": after("render_lidar", in_start_frame),
    "lidar-filter": after("render_lidar", threshold_as_count),
    "ego-mask-unknown": before("render_rgb", set_if(lambda r: True, insert_ego_mask=False)),
    "edit-insert-and-restore": before("restore_model_parameters", lambda r: setattr(r, "scene_id", "other")),
}  # fmt: skip


@pytest.mark.parametrize("rule", BROKEN)
def test_a_broken_rule_is_found(rule, monkeypatch, caplog):
    for name, procedure in BROKEN[rule].items():
        monkeypatch.setattr(SensorService, name, procedure)
    with street_server() as address, Target(address, allow_changes=True) as target:
        (outcome,) = run_checks(target, [rule])
    assert outcome.verdict == Verdict.FAIL and outcome.text, outcome


def test_an_optional_procedure_may_be_missing(monkeypatch):
    missing = before("render_lidar", raising(UnsupportedError("no LiDAR here")))
    monkeypatch.setattr(SensorService, "render_lidar", missing["render_lidar"])
    names = [name for name in CHECKS if name.startswith("lidar-")]
    with street_server() as address, Target(address) as target:
        outcomes = list(run_checks(target, names))
    assert {o.verdict for o in outcomes} == {Verdict.SKIP}
    assert all("no LiDAR here" in o.text for o in outcomes)


# --------------------------------------------------------------------------------------------------------- command line


def test_the_command_line_reports_and_sets_its_exit_status(monkeypatch, capsys):
    with street_server() as address:
        cli.main(["conformance", address, "--scene", "street", "--only", "png", "time-empty", "--json"])
        report = json.loads(capsys.readouterr().out)
        assert report["counts"] == {"PASS": 2, "FAIL": 0, "SKIP": 0}
        assert [o["name"] for o in report["outcomes"]] == ["png", "time-empty"]
    monkeypatch.setattr(SensorService, "render_rgb", BROKEN["time-empty"]["render_rgb"])
    with street_server() as address, pytest.raises(SystemExit) as ended:
        cli.main(["conformance", address, "--only", "png", "time-empty", "edit-insert-and-restore"])
    assert ended.value.code == 1
    text = capsys.readouterr().out
    assert "FAIL time-empty" in text and "expected INVALID_ARGUMENT, but it was accepted" in text
    assert "SKIP edit-insert-and-restore" in text and "1 PASS, 1 FAIL, 1 SKIP" in text


def test_the_command_line_lists_its_rules_and_refuses_unknown_checks(capsys):
    cli.main(["conformance", "--rules"])
    assert len(capsys.readouterr().out.splitlines()) == len(CHECKS)
    with pytest.raises(SystemExit):
        cli.main(["conformance", "127.0.0.1:1", "--only", "everything"])


def test_an_absent_server_is_one_line_soon(monkeypatch, capsys):
    assert CONNECT_S < 10
    monkeypatch.setattr(Target.connect, "__defaults__", (0.3,))
    with pytest.raises(SystemExit) as ended:
        cli.main(["conformance", "127.0.0.1:1"])
    said = capsys.readouterr()
    assert ended.value.code == 1 and said.out == ""
    assert said.err == (
        "nurec-sim: no gRPC server without TLS answers at 127.0.0.1:1 within 0.3 s; is it running there?\n"
    )


def test_an_absent_server_fails_every_check():
    with Target("127.0.0.1:1", "x", timeout_s=0.2) as target:
        outcomes = list(run_checks(target, ["version", "png"]))
    assert [o.verdict for o in outcomes] == [Verdict.FAIL] * 2
