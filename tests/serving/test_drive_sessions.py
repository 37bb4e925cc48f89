"""A driver's sessions: who may speak, in which order, how many, and for how long."""

import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import grpc
import numpy as np
import pytest
from driving_calls import (
    NOW_US,
    START_US,
    Looking,
    Steady,
    drive_message,
    driver,
    ego_message,
    ego_state,
    image_message,
    like_alpasim,
    opening,
    status,
    times_of,
    wait_until,
    xy_of,
)
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from nurec_sim import geometry
from nurec_sim.errors import TooLargeError
from nurec_sim.plugins import load_policy
from nurec_sim.serving.driver import RemotePolicy, session
from nurec_sim.serving.driver.session import Session
from nurec_sim.serving.wire import common, driving, driving_paths, egodriver
from nurec_sim.serving.wire.driving_states import ReportedState
from nurec_sim.sim.flat_world import demo_rig
from nurec_sim.types import LidarFrame, Needs

Code = grpc.StatusCode


def test_a_session_as_alpasim_leads_it():
    with driver(Looking) as stub:
        version = stub.get_version(common.Empty(), timeout=10)
        assert version.version_id.endswith(" looking")
        assert (version.grpc_api_version.major, version.grpc_api_version.minor) == (0, 54)
        stub.start_session(like_alpasim(opening(seed=9)), timeout=10)
        stub.submit_image_observation(like_alpasim(image_message()), timeout=10)
        states = [ego_state(START_US + 100_000 * i, x=0.5 * i) for i in range(6)]
        stub.submit_egomotion_observation(like_alpasim(ego_message(*states)), timeout=10)
        route = egodriver.RouteRequest(session_uuid="s")
        route.route.timestamp_us = NOW_US
        for i in range(20):
            route.route.waypoints.add(x=4.0 * i + 4)
        stub.submit_route(route, timeout=10)
        answer = stub.drive(drive_message(), timeout=10)
        assert times_of(answer).tolist() == [NOW_US, *(NOW_US + 100_000 * i for i in range(1, 51))]
        np.testing.assert_allclose(xy_of(answer)[:, 0], 2.5 + 0.5 * np.arange(51), atol=1e-5)
        np.testing.assert_allclose(xy_of(answer)[1:, 1], 9 % 7, atol=1e-5)
        assert not answer.terminate_session
        stub.close_session(egodriver.DriveSessionCloseRequest(session_uuid="s"), timeout=10)
        assert status(stub.drive, drive_message())[0] is Code.NOT_FOUND
        seen = stub.made[1].seen[0]
        assert (seen.t_us, seen.ego.speed_mps, len(seen.history)) == (NOW_US, 5.0, 6)
        assert seen.cameras["front"].rgb.shape == (96, 160, 3)
        assert seen.route_speed_mps.tolist() == [8.0] * 20
        np.testing.assert_allclose(seen.route_m[:, 0], 4.0 * np.arange(1, 21), atol=1e-5)
        assert seen.actors is None and len(seen.recorded_t_us) == 0


def test_sessions_have_policies_and_seeds_of_their_own():
    with driver() as stub, ThreadPoolExecutor(6) as pool:

        def drive_one(seed):
            name = f"session-{seed}"
            stub.start_session(opening(name, seed), timeout=20)
            for step in range(3):
                now_us = NOW_US + 500_000 * step
                stub.submit_egomotion_observation(ego_message(ego_state(now_us), session=name), timeout=20)
                answer = stub.drive(drive_message(now_us, name), timeout=20)
            return xy_of(answer)[-1, 1]

        assert list(pool.map(drive_one, range(6))) == [0, 1, 2, 3, 4, 5]
        assert sorted(len(policy.seen) for policy in stub.made) == [0, 3, 3, 3, 3, 3, 3]


def test_ids_must_be_known_new_and_sensible():
    with driver() as stub:
        stub.start_session(opening(), timeout=10)
        assert status(stub.start_session, opening()) == (
            Code.ALREADY_EXISTS,
            "session 's' is open already; close it, or take another session_uuid",
        )
        for procedure, message in (
            (stub.drive, drive_message(session="t")),
            (stub.submit_egomotion_observation, ego_message(session="t")),
            (stub.submit_image_observation, image_message(session="t")),
            (stub.submit_route, egodriver.RouteRequest(session_uuid="t")),
            (stub.submit_recording_ground_truth, egodriver.GroundTruthRequest(session_uuid="t")),
            (stub.close_session, egodriver.DriveSessionCloseRequest(session_uuid="t")),
        ):
            code, text = status(procedure, message)
            assert code is Code.NOT_FOUND and text.startswith("session 't' is not open")
        for name in ("", "x" * 257):
            code, text = status(stub.start_session, opening(name))
            assert code is Code.INVALID_ARGUMENT and "1 to 256 characters" in text


def test_only_so_many_sessions_and_a_closed_one_makes_room():
    with driver(max_sessions=2) as stub:
        stub.start_session(opening("a"), timeout=10)
        stub.start_session(opening("b"), timeout=10)
        code, text = status(stub.start_session, opening("c"))
        assert code is Code.RESOURCE_EXHAUSTED and text.startswith("2 sessions are open already")
        stub.close_session(egodriver.DriveSessionCloseRequest(session_uuid="a"), timeout=10)
        stub.start_session(opening("c"), timeout=10)


def test_sessions_that_nobody_speaks_to_are_closed():
    with driver(idle_s=0.2, max_sessions=1) as stub:
        stub.start_session(opening("old"), timeout=10)
        wait_until(lambda: _answers(stub.start_session, opening("new")))
        assert status(stub.drive, drive_message(session="old"))[0] is Code.NOT_FOUND


def _answers(procedure, message):
    try:
        procedure(message, timeout=10)
    except grpc.RpcError:
        return False
    return True


def test_driving_needs_a_recent_ego_pose():
    with driver() as stub:
        stub.start_session(opening(), timeout=10)
        assert status(stub.drive, drive_message()) == (
            Code.FAILED_PRECONDITION,
            f"no ego pose up to time_now_us {NOW_US} has been submitted",
        )
        stub.submit_egomotion_observation(ego_message(), timeout=10)
        code, text = status(stub.drive, drive_message(NOW_US - 1))
        assert code is Code.FAILED_PRECONDITION and text.endswith(f"the first one is of {NOW_US}")
        code, text = status(stub.drive, drive_message(NOW_US + 1_500_000))
        assert code is Code.FAILED_PRECONDITION and "the newest ego pose is 1.500 s older" in text
        assert len(stub.drive(drive_message(NOW_US + 1_000_000), timeout=10).trajectory.poses) == 51


def test_a_camera_that_the_policy_needs_must_have_sent_a_recent_image():
    with driver(Looking) as stub:
        stub.start_session(opening(), timeout=10)
        stub.submit_egomotion_observation(ego_message(), timeout=10)
        code, text = status(stub.drive, drive_message())
        assert code is Code.FAILED_PRECONDITION and "needs camera 'front', of which no image" in text
        stub.submit_image_observation(image_message(data=b""), timeout=10)  # AlpaSim with its renderer switched off
        assert status(stub.drive, drive_message())[0] is Code.FAILED_PRECONDITION
        stub.submit_image_observation(image_message(end_us=NOW_US + 100_000), timeout=10)
        code, text = status(stub.drive, drive_message())
        assert code is Code.FAILED_PRECONDITION and text == (
            f"no frame of camera 'front' up to time_now_us {NOW_US} has been submitted"
        )
        stub.submit_image_observation(image_message(end_us=NOW_US - 1_200_000), timeout=10)
        assert "the newest frame of camera 'front' is 1.200 s older" in status(stub.drive, drive_message())[1]
        stub.submit_image_observation(image_message(end_us=NOW_US), timeout=10)
        stub.drive(drive_message(), timeout=10)
        assert stub.made[-1].seen[0].cameras["front"].end_us == NOW_US


def test_observations_may_come_in_any_order_and_twice():
    shades = {NOW_US - 200_000: 10, NOW_US - 100_000: 20, NOW_US: 30, NOW_US + 100_000: 40}
    with driver(Looking) as stub:
        stub.start_session(opening(), timeout=10)
        for t_us in (NOW_US, NOW_US + 100_000, NOW_US - 200_000, NOW_US - 100_000, NOW_US):
            image = image_message(np.full((96, 160, 3), shades[t_us], np.uint8), t_us)
            stub.submit_image_observation(image, timeout=10)
            stub.submit_egomotion_observation(ego_message(ego_state(t_us, x=(t_us - NOW_US) / 1e5)), timeout=10)
        stub.drive(drive_message(), timeout=10)
        seen = stub.made[-1].seen[0]
        assert seen.cameras["front"].rgb[0, 0, 0] == 30
        assert [state.t_us for state in seen.history] == [NOW_US - 200_000, NOW_US - 100_000, NOW_US]
        assert seen.ego.world_from_rig[0, 3] == 0.0


def test_what_only_our_clients_submit_is_asked_for_by_name():
    class Privileged(Steady):
        needs = Needs(privileged=True)

    class Scanning(Steady):
        needs = Needs(lidars=("any",))

    for policy, text in ((Privileged, "reads true actors (privileged)"), (Scanning, "needs LiDAR 'any'")):
        with driver(policy) as stub:
            stub.start_session(like_alpasim(opening()), timeout=10)
            stub.submit_egomotion_observation(ego_message(), timeout=10)
            code, said = status(stub.drive, drive_message())
            assert code is Code.FAILED_PRECONDITION and text in said


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda m: m.rollout_spec.vehicle.available_cameras[0].intrinsics.ClearField("opencv_pinhole_param"),
         "available_cameras, camera 'front_wide': camera_intrinsics must hold"),
        (lambda m: m.rollout_spec.vehicle.available_cameras[0].ClearField("rig_to_camera"),
         "available_cameras, camera 'front_wide': rig_to_camera must have a unit quaternion"),
        (lambda m: m.rollout_spec.vehicle.body.size_m.append(1.0), "vehicle.body needs 3 finite center_m"),
        (lambda m: m.rollout_spec.vehicle.available_cameras.append(m.rollout_spec.vehicle.available_cameras[0]),
         "each camera needs a logical_id of its own, got 'front_wide' beside ['front_wide']"),
        (lambda m: m.rollout_spec.vehicle.available_lidars[0].ClearField("logical_id"),
         "each LiDAR needs a logical_id of its own, got '' beside []"),
    ],
)  # fmt: skip
def test_a_car_that_makes_no_sense_opens_no_session(spoil, text):
    message = opening()
    spoil(message)
    with driver() as stub:
        code, said = status(stub.start_session, message)
        assert code is Code.INVALID_ARGUMENT and said.startswith(text)
        stub.start_session(opening(), timeout=10)


def test_policies_learn_sensors_outline_and_seed():
    rig = demo_rig()
    with driver() as stub:
        stub.start_session(opening(seed=2**63 + 5, rig=rig, names={"front": "front_wide"}), timeout=10)
        policy = stub.made[-1]
        assert policy.seed == 2**63 + 5 and policy.rig.body == rig.body
        assert list(policy.rig.cameras) == ["front_wide"] and list(policy.rig.lidars) == ["top"]
        camera = policy.rig.cameras["front_wide"]
        assert camera.lens == rig.cameras["front_wide"].lens
        np.testing.assert_array_equal(camera.rig_from_camera, rig.cameras["front_wide"].rig_from_camera)
        np.testing.assert_array_equal(policy.rig.lidars["top"].elevation_rad, rig.lidars["top"].elevation_rad)


def test_health_reflection_and_needs_answer():
    with driver(Looking) as stub:
        health = health_pb2_grpc.HealthStub(stub.channel)
        for name in ("", driving.DRIVER_SERVICE):
            found = health.Check(health_pb2.HealthCheckRequest(service=name), timeout=10)
            assert found.status == health_pb2.HealthCheckResponse.SERVING
        reflection = reflection_pb2_grpc.ServerReflectionStub(stub.channel)
        asked = iter([reflection_pb2.ServerReflectionRequest(list_services="")])
        (reply,) = list(reflection.ServerReflectionInfo(asked, timeout=10))
        assert driving.DRIVER_SERVICE in [s.name for s in reply.list_services_response.service]
        described = stub.get_policy(common.Empty(), timeout=10)
        assert driving.read_policy(described) == ("looking", Looking.needs)


def test_only_drivers_that_allow_it_are_shut_down():
    with driver() as stub:
        assert status(stub.shut_down, common.Empty())[0] is Code.UNIMPLEMENTED
    with driver(allow_shut_down=True) as stub:
        stub.shut_down(common.Empty(), timeout=10)
        wait_until(lambda: not _answers(stub.get_version, common.Empty()))


def test_the_command_line_serves_a_policy_until_it_is_stopped():
    command = [sys.executable, "-W", "error", "-m", "nurec_sim.cli", "drive-grpc", "constant_velocity", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        address = re.fullmatch(r"Serving on (127\.0\.0\.1:\d+)\n", process.stdout.readline())[1]
        with RemotePolicy(address) as remote:
            assert remote.name == f"constant_velocity@{address}"
        process.terminate()
        assert process.communicate(timeout=20) == ("", "") and process.returncode == 0
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["log_reply"], "unknown policy 'log_reply'"),
        (["log_replay", "--host", "0.0.0.0"], "refused to listen at '0.0.0.0'"),
        (["log_replay", "--sessions", "0"], "max_sessions must be finite and above 0, got 0"),
        (["log_replay", "--port", "99999"], "cannot listen at port 99999"),
    ],
)
def test_the_command_line_says_what_is_wrong(arguments, text, capsys):
    from nurec_sim.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["drive-grpc", *arguments])
    assert ended.value.code == 1
    assert text in capsys.readouterr().err


def test_a_recorded_future_told_once_serves_every_later_plan():
    with driver(lambda: load_policy("log_replay")) as stub:
        stub.start_session(like_alpasim(opening()), timeout=10)
        times = START_US + 130_000 * np.arange(60)  # another rhythm than that of plans
        message = egodriver.GroundTruthRequest(session_uuid="s")
        x = 6.5e-6 * (times - START_US)
        recorded = np.column_stack([x, 0.01 * x**2, np.arctan(0.02 * x)])
        driving_paths.write_recorded(ego_state(START_US, 50.0, 20.0, 1.2), times, recorded, message.ground_truth)
        stub.submit_recording_ground_truth(like_alpasim(message), timeout=10)
        for state in (ego_state(START_US, 50.0, 20.0, 1.2), ego_state(NOW_US, 53.0, 24.0, 1.9)):
            stub.submit_egomotion_observation(like_alpasim(ego_message(state)), timeout=10)
        answer = stub.drive(drive_message(), timeout=10)
    assert times_of(answer).tolist() == [NOW_US, *(NOW_US + 100_000 * i for i in range(1, 51))]
    x = 6.5e-6 * (times_of(answer)[1:] - START_US)
    inside = geometry.pose_from_xyyaw(50.0, 20.0, 1.2)
    expected = geometry.transform_points(inside, np.column_stack([x, 0.01 * x**2, 0 * x]))[:, :2]
    np.testing.assert_allclose(xy_of(answer)[1:], expected, atol=5e-3)  # 130 ms of a parabola drawn straight


def test_speed_and_turn_follow_from_poses_where_nobody_tells_them():
    with driver() as stub:
        stub.start_session(opening(), timeout=10)
        states = [ego_state(NOW_US - 50_000 * i, x=-0.4 * i, yaw=-0.01 * i) for i in range(30)]
        message = like_alpasim(ego_message(*states))
        del message.dynamic_states[:]
        stub.submit_egomotion_observation(message, timeout=10)
        stub.drive(drive_message(), timeout=10)
        seen = stub.made[-1].seen[0]
    assert seen.ego.speed_mps == pytest.approx(8.0, abs=0.01)
    assert seen.ego.yaw_rate_radps == pytest.approx(0.2, abs=1e-4)
    assert [seen.t_us - state.t_us for state in seen.history[::-1]] == [100_000 * i for i in range(15)]


def test_a_route_of_an_earlier_time_is_moved_with_the_car():
    with driver() as stub:
        stub.start_session(opening(), timeout=10)
        stub.submit_egomotion_observation(ego_message(ego_state(NOW_US - 200_000), ego_state(x=1.0, y=2.0, yaw=0.5)))
        now = geometry.pose_from_xyyaw(1.0, 2.0, 0.5)
        halfway, first = geometry.pose_from_xyyaw(0.5, 1.0, 0.25), np.eye(4)
        for told_us, then in ((NOW_US, now), (0, now), (NOW_US - 100_000, halfway), (NOW_US - 200_000, first)):
            route = egodriver.RouteRequest(session_uuid="s")
            route.route.timestamp_us = told_us
            route.route.waypoints.add(x=10.0)
            stub.submit_route(route, timeout=10)
            stub.drive(drive_message(), timeout=10)
            moved = geometry.inverse(now) @ then @ [10.0, 0.0, 0.0, 1.0]
            np.testing.assert_allclose(stub.made[-1].seen[-1].route_m, [moved[:2]], atol=1e-5)


def test_sweeps_and_images_share_what_a_session_may_hold(monkeypatch):
    rig = demo_rig()
    told = Session(driving.SessionStart("s", 0, rig, {}), Needs(lidars=("any",)), 8.0)
    monkeypatch.setattr(session, "MAX_SESSION_BYTES", 30_000)

    def sweep(end_us):
        points, ones = np.ones((1000, 3), np.float32), np.ones(1000, np.float32)
        return LidarFrame(rig.lidars["top"], end_us - 100_000, end_us, points, ones, ones, np.zeros(1000, np.int32))

    told.add_sweep(sweep(NOW_US))
    told.add_sweep(sweep(NOW_US))  # in the place of the first
    with pytest.raises(TooLargeError, match="a session may hold 30000 bytes of images and sweeps, got 48000"):
        told.add_sweep(sweep(NOW_US + 1))
    told.add_states([ReportedState(NOW_US, np.eye(4))])
    assert told.question(NOW_US).sweeps["any"].end_us == NOW_US
