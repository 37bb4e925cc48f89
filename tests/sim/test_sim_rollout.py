"""The closed loop: what it keeps, what it promises, and that nothing a policy does breaks it."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from nurec_sim import geometry
from nurec_sim.errors import ScenarioError
from nurec_sim.plugins import load_policy
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.sim.policy_sensors import exposure_us, find_camera, horizontal_fov_rad
from nurec_sim.sim.rollout import start_offset, timeline
from nurec_sim.sim.scenario import ActorEdit, Perturbation, SensorSettings
from nurec_sim.types import CameraFrame, Fisheye, LidarFrame, Needs, Pinhole, Plan, Rig, Shutter


class Scripted:
    """A policy made of a function."""

    name = "scripted"

    def __init__(self, answer, needs=Needs()):  # noqa: B008
        self.answer, self.needs, self.seen = answer, needs, []

    def reset(self, rig, seed):
        self.seen = []

    def plan(self, observation):
        self.seen.append(observation)
        return self.answer(observation)


def ahead(observation, speed=None, seconds=5.0):
    times = np.arange(1, int(seconds * 10) + 1)
    pose = np.zeros((len(times), 3))
    pose[:, 0] = (observation.ego.speed_mps if speed is None else speed) * times / 10
    return Plan(observation.t_us + 100_000 * times, pose)


def blind_sense(requests):
    raise AssertionError("nothing may be rendered for a policy that needs nothing")


def drive(policy, world, sense=None, **keys):
    settings = {"name": "test", "duration_s": 6.0, **keys}
    seed = settings.pop("seed", 0)
    return run_rollout(Scenario(**settings), policy, sense or world.sense, world, seed=seed)


def signature(rollout):
    return rollout.world_from_rig.tobytes() + b"".join(plan.pose.tobytes() for _, plan in rollout.plans)


# ------------------------------------------------------------------------------------------- driving


def test_constant_velocity_stays_on_a_straight_road():
    world = worlds.straight_road()
    rollout = drive(load_policy("constant_velocity"), world, blind_sense)
    assert rollout.status == "ok" and len(rollout.states) == 61
    assert np.abs(rollout.world_from_rig[:, 1, 3]).max() < 1e-6
    assert rollout.world_from_rig[-1, 0, 3] == pytest.approx(60.0, abs=0.05)
    assert np.all(np.diff(rollout.t_us) == 100_000)
    assert rollout.first_closed_loop_us == world.span_us[0] + 500_000
    assert [t for t, _ in rollout.plans] == list(
        range(world.span_us[0] + 500_000, world.span_us[0] + 6_000_000, 500_000)
    )


def test_constant_velocity_leaves_a_curve():
    world = worlds.curve()
    rollout = drive(load_policy("constant_velocity"), world, blind_sense, warm_up_s=2.0)
    _, lateral = geometry.project_to_polyline(rollout.world_from_rig[:, :2, 3], world.road_m)
    assert np.abs(lateral).max() > world.road_width_m / 2


@pytest.mark.parametrize("controller", ["pursuit_pi", "perfect"])
@pytest.mark.parametrize(
    "world", [worlds.straight_road(), worlds.curve(), worlds.hill(), worlds.standing()], ids=lambda w: w.id
)
def test_log_replay_follows_the_log(world, controller):
    rollout = drive(load_policy("log_replay"), world, blind_sense, controller=controller)
    recorded = world.ego.at(rollout.t_us)
    error = np.linalg.norm(rollout.world_from_rig[:, :3, 3] - recorded[:, :3, 3], axis=1)
    assert error.max() < (0.3 if controller == "pursuit_pi" else 0.05)


def test_log_replay_follows_a_log_that_brakes_and_starts_again():
    t_s = np.arange(81) / 10
    speeds = np.interp(t_s, [0, 1, 4, 5, 8], [9, 9, 0, 0, 6])
    world = worlds.flat_world("stop-and-go", worlds.straight_line(), speeds, 8.0)
    rollout = drive(load_policy("log_replay"), world, blind_sense, duration_s=8.0)
    error = np.linalg.norm(rollout.world_from_rig[:, :2, 3] - world.ego.at(rollout.t_us)[:, :2, 3], axis=1)
    assert error.max() < 0.3
    assert min(state.speed_mps for state in rollout.states) < 0.1


def test_cameras_keep_their_height_on_a_slope():
    world = worlds.hill(slope=0.1)
    rollout = drive(Scripted(lambda o: ahead(o, speed=6.0)), world, blind_sense)
    poses = rollout.world_from_rig
    assert np.allclose(poses[:, 2, 3], 0.1 * poses[:, 0, 3], atol=1e-6)
    assert np.allclose(poses[:, 2, 0], np.sin(np.arctan(0.1)), atol=1e-6)


def test_lead_car_brakes_and_only_the_seeing_stop():
    world = worlds.braking_lead()
    gaps = {}
    for name in ("route_follower", "lidar_aeb", "constant_velocity"):
        rollout = drive(load_policy(name), world, duration_s=8.0)
        front = rollout.world_from_rig[:, 0, 3] + 3.85
        gaps[name] = (rollout.actors["lead"][:, 0, 3] - 2.25 - front).min()
    assert gaps["route_follower"] > 0.5
    assert gaps["lidar_aeb"] > 0.0
    assert gaps["constant_velocity"] < -1.0


# ------------------------------------------------------------------------------------------- determinism


@pytest.mark.parametrize("name", ["route_follower", "lidar_aeb", "camera_road_follower"])
def test_second_run_and_other_clock_give_the_same_bytes(name):
    world = worlds.braking_lead()
    scatter = Perturbation(lateral_m=0.2, yaw_deg=1, speed_fraction=0.05)
    keys = {"perturbation": scatter, "seed": 3, "duration_s": 4.0}
    policy = load_policy(name)
    first = drive(policy, world, **keys)
    again = drive(policy, world, **keys)
    later = worlds.shifted_in_time(world, 1_700_000_000_123_456)
    shifted = drive(load_policy(name), later, **keys)
    assert signature(first) == signature(again)
    assert first.world_from_rig.tobytes() == shifted.world_from_rig.tobytes()


def test_other_world_frame_gives_the_same_drive():
    turn = geometry.pose_from_xyyaw(120.0, -45.0, 2.1, z=7.0)
    world = worlds.curve()
    here = drive(load_policy("route_follower"), world, blind_sense)
    there = drive(load_policy("route_follower"), worlds.moved(world, turn), blind_sense)
    assert np.allclose(there.world_from_rig, turn @ here.world_from_rig, atol=1e-6)


def test_start_is_scattered_by_scene_and_seed_only():
    scatter = Perturbation(lateral_m=0.3, yaw_deg=2, speed_fraction=0.1)
    assert start_offset(Perturbation(), "a", 5) == (0.0, 0.0, 1.0)
    assert start_offset(scatter, "a", 5) == start_offset(scatter, "a", 5)
    assert len({start_offset(scatter, scene, seed) for scene in "ab" for seed in range(4)}) == 8
    world = worlds.straight_road()
    firsts = [
        drive(load_policy(n), world, blind_sense, perturbation=scatter, seed=2)
        for n in ("constant_velocity", "log_replay")
    ]
    k = 5  # the last state of the warm-up
    assert firsts[0].world_from_rig[k].tobytes() == firsts[1].world_from_rig[k].tobytes()
    lateral, yaw, factor = start_offset(scatter, world.id, 2)
    assert firsts[0].world_from_rig[k, 1, 3] == pytest.approx(lateral)
    assert geometry.yaw_of(firsts[0].world_from_rig[k]) == pytest.approx(yaw)
    assert firsts[0].states[k].speed_mps == pytest.approx(10.0 * factor)


def test_blind_policies_do_not_change_with_the_renderer():
    world = worlds.braking_lead()
    for name in ("log_replay", "constant_velocity", "route_follower"):
        assert signature(drive(load_policy(name), world, world.sense)) == signature(
            drive(load_policy(name), world, blind_sense)
        )


# ------------------------------------------------------------------------------------------- what policies do wrong


def nan_plan(o):
    plan = ahead(o)
    pose = plan.pose.copy()
    pose[7, 1] = np.nan
    return Plan(plan.t_us, pose)


BAD = {
    "raises": (lambda o: 1 / 0, "policy_error", "ZeroDivisionError"),
    "none": (lambda o: None, "plan_error", "must return a nurec_sim.types.Plan, got NoneType"),
    "nan": (nan_plan, "plan_error", "pose 7 is"),
    "empty": (lambda o: Plan(np.zeros(0, np.int64), np.zeros((0, 3))), "plan_error", "plan is empty"),
    "short": (lambda o: ahead(o, seconds=1.0), "plan_error", "ends 1.000 s ahead; it must reach at least 2.5 s"),
    "backwards": (lambda o: Plan(ahead(o).t_us[::-1], ahead(o).pose), "plan_error", "times must increase"),
    "late": (lambda o: Plan(ahead(o).t_us - 9_000_000, ahead(o).pose), "plan_error", "too late"),
    "shape": (lambda o: Plan(ahead(o).t_us, ahead(o).pose[:, :2]), "plan_error", "got (50,) and (50, 2)"),
    "seconds": (lambda o: Plan(ahead(o).t_us / 1e6, ahead(o).pose), "plan_error", "integer microseconds"),
    "words": (lambda o: Plan(ahead(o).t_us, np.full((50, 3), "left")), "plan_error", "must be numbers"),
    "far": (lambda o: ahead(o, speed=1e5), "plan_error", "within 10000 m"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_plan_fails_the_rollout_and_keeps_what_was_driven(name):
    answer, kind, text = BAD[name]
    policy = Scripted(lambda o: ahead(o) if len(policy.seen) < 3 else answer(o))
    rollout = drive(policy, worlds.straight_road(), blind_sense)
    assert rollout.status == "failed" and text in rollout.error
    assert [event.kind for event in rollout.events] == [kind]
    assert len(rollout.states) == 5 + 1 + 10 and len(rollout.plans) == 2
    assert rollout.states[-1].t_us == rollout.events[0].t_us


def test_a_policy_may_stop_the_session():
    def answer(o):
        stop = len(policy.seen) == 4
        return Plan(np.zeros(0, np.int64), np.zeros((0, 3)), stop_session=True) if stop else ahead(o)

    policy = Scripted(answer)
    rollout = drive(policy, worlds.straight_road(), blind_sense)
    assert rollout.status == "ok" and rollout.error == ""
    assert [event.kind for event in rollout.events] == ["stop_session"]
    assert len(rollout.states) == 5 + 1 + 15


def test_a_reset_that_raises_and_a_renderer_that_fails():
    policy = Scripted(ahead)
    policy.reset = lambda rig, seed: [][0]
    rollout = drive(policy, worlds.straight_road(), blind_sense)
    assert rollout.status == "failed" and rollout.events[0].kind == "policy_error" and len(rollout.states) == 6

    def broken(requests):
        raise OSError("connection lost")

    needs = Needs(cameras=("front",))
    rollout = drive(Scripted(ahead, needs), worlds.straight_road(), broken)
    assert rollout.status == "failed" and rollout.error == "OSError: connection lost"
    assert rollout.events[0].kind == "sense_error"
    rollout = drive(Scripted(ahead, needs), worlds.straight_road(), lambda requests: [])
    assert "returned 0 frames for 1 requests" in rollout.error


# ------------------------------------------------------------------------------------------- sensors


def test_frames_are_asked_for_at_plan_times_inside_the_span():
    world, asked = worlds.straight_road(), []

    def sense(requests):
        asked.append(requests)
        return world.sense(requests)

    policy = Scripted(ahead, Needs(cameras=("front",), lidars=("any",), image_width_px=160))
    rollout = drive(policy, world, sense, warm_up_s=0.0, duration_s=20.0)
    assert rollout.status == "ok" and len(asked) == len(rollout.plans)
    for (camera, lidar), (t_us, _) in zip(asked, rollout.plans, strict=True):
        assert (camera.sensor.width_px, camera.sensor.height_px) == (160, 96)
        for request in (camera, lidar):
            assert world.span_us[0] <= request.start_us < request.end_us < world.span_us[1]
            assert request.end_us in (t_us, t_us + 1)
            assert request.actors == {}
        here = rollout.world_from_rig[list(rollout.t_us).index(t_us)]
        assert np.allclose(camera.world_from_sensor[1], here @ camera.sensor.rig_from_camera, atol=1e-12)
        assert np.allclose(lidar.world_from_sensor[1], here @ lidar.sensor.rig_from_lidar, atol=1e-12)
    spun = asked[3][1]
    assert spun.end_us - spun.start_us == 100_000
    assert np.linalg.norm(spun.world_from_sensor[1, :3, 3] - spun.world_from_sensor[0, :3, 3]) == pytest.approx(
        1.0, abs=0.02
    )
    observation = policy.seen[0]
    assert isinstance(observation.cameras["front"], CameraFrame) and isinstance(observation.lidars["any"], LidarFrame)


def test_policies_only_meet_ideal_pinholes():
    world = worlds.straight_road()
    camera = next(iter(world.rig.cameras.values()))
    round_camera = replace(camera, lens=Fisheye(200.0, 200.0, 320.0, 192.0))
    world = replace(world, rig=Rig({camera.id: round_camera}, {}))
    policy = Scripted(ahead, Needs(cameras=("front",)))
    assert drive(policy, world, duration_s=1.5).status == "ok"
    seen = policy.seen[0].cameras["front"].camera
    assert seen.ideal_pinhole is not None
    fov = 2 * np.arctan(seen.width_px / 2 / seen.lens.fx_px)
    assert np.degrees(fov) == pytest.approx(min(100.0, np.degrees(2 * 320 / 200)), abs=0.5)
    assert seen.id == camera.id and np.array_equal(seen.rig_from_camera, camera.rig_from_camera)


def turned(camera, name, yaw_deg):
    turn = geometry.pose_from_xyyaw(0.0, 0.0, np.deg2rad(yaw_deg))
    return replace(camera, id=name, rig_from_camera=turn @ camera.rig_from_camera)


def test_cameras_are_found_by_where_they_look():
    front = worlds.straight_road().rig.cameras["front_wide"]
    rear_left, left, right = (turned(front, *each) for each in (("b", 140), ("c", 45), ("d", -95)))
    rig = Rig({camera.id: camera for camera in (front, rear_left, left, right)}, {})
    assert find_camera(rig, "left").id == "c" and find_camera(rig, "right").id == "d"
    with pytest.raises(ScenarioError, match="camera 'left' is needed but the rig has no such camera"):
        find_camera(Rig({"a": front, "b": rear_left}, {}), "left")
    # No tele camera: 30 of the front camera's 90 degrees, with as many pixels; 320 / tan(15 degrees) = 1194.3.
    tele = find_camera(rig, "tele")
    assert tele.id == "front_wide" and (tele.width_px, tele.height_px) == (640, 384)
    assert tele.lens.fx_px == pytest.approx(1194.26, abs=0.01) and np.isclose(horizontal_fov_rad(tele), np.deg2rad(30))
    narrow = replace(front, id="narrow", lens=replace(front.lens, fx_px=900.0, fy_px=900.0))  # 39 degrees
    assert find_camera(replace(rig, cameras={**rig.cameras, "narrow": narrow}), "tele").id == "narrow"
    assert find_camera(replace(rig, cameras={**rig.cameras, "narrow": narrow}), "front").id == "front_wide"


def test_front_is_the_wide_camera_that_looks_forward():
    world = worlds.straight_road()
    wide = next(iter(world.rig.cameras.values()))
    tele = replace(wide, id="tele", lens=Pinhole(1000.0, 1000.0, 320.0, 192.0))
    turn = geometry.pose(geometry.rotation_from_yaw(0.9), np.zeros(3))
    side = replace(wide, id="side", rig_from_camera=turn @ wide.rig_from_camera)
    rig = Rig({c.id: c for c in (side, tele, wide, replace(wide, id="right_eye"))}, {})
    policy = Scripted(ahead, Needs(cameras=("front",)))
    drive(policy, replace(world, rig=rig), duration_s=1.0)
    assert policy.seen[0].cameras["front"].camera.id == wide.id


def test_a_missing_sensor_fails_with_what_the_rig_has():
    world = worlds.straight_road()
    rollout = drive(Scripted(ahead, Needs(cameras=("rear",))), world)
    assert rollout.status == "failed" and "camera 'rear'" in rollout.error and "['front_wide']" in rollout.error
    rollout = drive(Scripted(ahead, Needs(lidars=("any",))), replace(world, rig=Rig(world.rig.cameras, {})))
    assert rollout.events[0].kind == "sensor_missing" and "LiDAR 'any'" in rollout.error


def test_recorded_frames_stay_hidden_from_the_policy():
    world, heard = worlds.straight_road(), []
    scenario = Scenario(
        name="film", duration_s=2.0, warm_up_s=0.5, sensors=SensorSettings(record_cameras=("front",), interval_s=0.1)
    )
    policy = Scripted(ahead)
    rollout = run_rollout(scenario, policy, world.sense, world, on_frames=lambda t, frames: heard.append((t, frames)))
    assert [t for t, _ in heard] == list(rollout.t_us[5:-1])
    assert all(set(frames) == {"front"} for _, frames in heard)
    assert all(observation.cameras == {} for observation in policy.seen)


# ------------------------------------------------------------------------------------------- actors


def test_actors_are_there_only_while_recorded():
    world = worlds.straight_road()
    track = worlds.car("late", worlds.straight_line(), 60.0 + np.arange(11), start_us=3_000_000)
    rollout = drive(load_policy("log_replay"), replace(world, tracks=(track,)), blind_sense)
    present = ~np.isnan(rollout.actors["late"][:, 0, 0])
    assert np.array_equal(present, (rollout.t_us >= 3_000_000) & (rollout.t_us <= 4_000_000))
    assert np.array_equal(rollout.actors["late"][present], track.path.at(rollout.t_us[present]))
    assert rollout.actor_sizes_m["late"] == worlds.CAR_M and rollout.actor_labels["late"] == "automobile"


def test_edited_actors_are_moved_in_requests_and_in_the_rollout():
    world, asked = worlds.braking_lead(), []

    def sense(requests):
        asked.extend(requests)
        return world.sense(requests)

    policy = Scripted(ahead, Needs(cameras=("front",), image_width_px=64, privileged=True))
    rollout = drive(policy, world, sense, actors={"lead": ActorEdit(shift_m=(2.0, 1.0))}, duration_s=2.0)
    recorded = world.tracks[0].path.at(rollout.t_us)
    assert np.allclose(rollout.actors["lead"][:, :3, 3] - recorded[:, :3, 3], [2.0, 1.0, 0.0])
    assert set(asked[0].actors) == {"lead"} and asked[0].actors["lead"].shape == (2, 4, 4)
    assert policy.seen[0].actors[0].rig_from_box[1, 3] == pytest.approx(1.0, abs=1e-9)
    assert policy.seen[0].actors[0].velocity_mps == pytest.approx([10.0, 0.0], abs=1e-6)
    asked.clear()
    rollout = drive(policy, world, sense, actors={"lead": {"hide": True}}, duration_s=2.0)
    assert np.isnan(rollout.actors["lead"]).all() and policy.seen[0].actors == ()
    assert asked[0].actors["lead"][1, 2, 3] < -50
    rollout = drive(policy, world, actors={"nobody": {"hide": True}})
    assert rollout.status == "failed" and "actors ['nobody'] are not in the scene; have ['lead']" in rollout.error


# ------------------------------------------------------------------------------------------- short logs


@pytest.mark.parametrize("world", [worlds.single_pose(), worlds.two_poses(), worlds.standing(1.0)], ids=lambda w: w.id)
@pytest.mark.parametrize(
    "name", ["log_replay", "constant_velocity", "route_follower", "lidar_aeb", "camera_road_follower"]
)
@pytest.mark.parametrize("warm_up_s", [0.0, 0.5])
def test_short_logs_clip_the_rollout(world, name, warm_up_s):
    rollout = drive(load_policy(name), world, warm_up_s=warm_up_s)
    assert rollout.status == "ok", rollout.error
    assert 1 <= len(rollout.states) <= 11
    assert rollout.states[-1].t_us < world.span_us[1]
    assert any(event.kind == "clipped" and "the recording ends" in event.text for event in rollout.events)
    if world.id == "standing":
        assert np.linalg.norm(rollout.world_from_rig[-1, :2, 3]) < (0.5 if name != "camera_road_follower" else 3.0)


def test_a_start_beyond_the_recording_fails_with_its_length():
    rollout = drive(load_policy("log_replay"), worlds.straight_road(duration_s=3.0), start_s=30.0)
    assert rollout.status == "failed" and len(rollout.states) == 1
    assert "starts 30 s into scene 'straight-road', which lasts 3.0 s" in rollout.error


def test_timeline_is_cut_to_whole_states():
    world = worlds.straight_road(duration_s=3.0)
    world = replace(world, span_us=(world.span_us[0] + 50_000, world.span_us[1] - 20_000))
    times = timeline(Scenario(name="x", duration_s=10.0), world)
    assert times.start_us == world.span_us[0] and (times.end_us - times.start_us) % 100_000 == 0
    assert times.end_us < world.span_us[1] and times.clipped


# ------------------------------------------------------------------------------------------- exposures


@pytest.mark.parametrize("form", ["mapping", "method"])
def test_exposures_last_as_long_as_the_log_says(form):
    """A scene tells them by a mapping, a clip by a method; the usual one of 30, 30 and 10 ms is 30 ms."""
    times = np.array([[0, 30_000], [100_000, 130_000], [200_000, 210_000]])
    known = {"front_wide": times}
    world = worlds.straight_road()
    world = replace(world, camera_times_us=known if form == "mapping" else lambda camera: known.get(camera, ()))
    rolling = replace(world.rig.cameras["front_wide"], shutter=Shutter.TOP_TO_BOTTOM)
    assert exposure_us(world, rolling) == 30_000
    assert exposure_us(world, replace(rolling, shutter=Shutter.GLOBAL)) == 0
    assert exposure_us(world, replace(rolling, id="other")) == 0
