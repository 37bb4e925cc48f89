"""Scores of a scene beside its log: FLIP, sharpness, holes, regions, false obstacles, and what is held out."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import Street, camera

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate import lidar_scores, log, score_scene
from nurec_sim.evaluate.image_scores import FrameScore, image_request, summarized
from nurec_sim.evaluate.log_regions import actor_mask, seen_points
from nurec_sim.evaluate.log_tables import figure_rows
from nurec_sim.evaluate.scores.flip import flip, flip_map
from nurec_sim.evaluate.scores.free_space import FiredSweep, RecordedBeams, false_obstacles
from nurec_sim.evaluate.scores.lidar import CloudScore, LidarScore, copied_sweep
from nurec_sim.evaluate.scores.sharpness import OCTAVES, octave_energy, sharpness
from nurec_sim.evaluate.scores.surfaces import KINDS, surfaces_of
from nurec_sim.logs import hold_out, without_images
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
from nurec_sim.types import MOVABLE_LABELS, LidarFrame, Pinhole, Track, Trajectory

SMALL = LiftSettings(sky_px=32, views=ViewSettings(levels=32))


def waves():
    """A colourful pattern, and the same darker with a red patch."""
    y, x = np.mgrid[0:120, 0:160]
    first = np.stack([128 + 100 * np.sin(x / 7), 128 + 90 * np.sin(y / 11 + 1), 128 + 100 * np.cos((x + y) / 5)], -1)
    second = first * 0.9
    second[40:60, 50:90] = [250, 20, 30]
    return np.clip(first, 0, 255).astype(np.uint8), np.clip(second, 0, 255).astype(np.uint8)


def test_flip_gives_what_its_authors_program_gives():
    """``flip_evaluator.evaluate(reference, test, "LDR")`` of flip-evaluator 1.7 on the same arrays."""
    reference, image = waves()
    assert flip(image, reference) == pytest.approx(FLIP_MEAN, abs=2e-5)
    assert flip_map(image, reference)[50, 70] == pytest.approx(FLIP_INSIDE, abs=2e-5)


FLIP_MEAN, FLIP_INSIDE = 0.359626, 0.968085


def test_flip_of_equal_images_is_nothing_and_sizes_must_agree():
    image, _ = waves()
    assert flip(image, image) == 0
    with pytest.raises(ValueError, match=r"two 8-bit RGB images of one size are needed, got \(120, 159, 3\) uint8"):
        flip(image[:, 1:], image)


@pytest.mark.parametrize("cycles_per_px, octave", [(0.08, "1/16"), (0.2, "1/8"), (0.4, "1/4")])
def test_energy_of_a_wave_lies_in_its_octave(cycles_per_px, octave):
    wave = 128 + 100 * np.sin(2 * np.pi * cycles_per_px * np.arange(128))
    energy = octave_energy(np.broadcast_to(wave[None, :, None], (96, 128, 3)).astype(np.uint8))
    assert energy[octave] > 0.99 * sum(energy.values())


def test_half_the_contrast_is_a_quarter_of_the_energy():
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3))
    halved = (noise // 2).astype(np.uint8)
    assert all(abs(part - 0.25) < 0.01 for part in sharpness(halved, noise.astype(np.uint8)).values())


def wall_sweep(x_m=20.0, y_m=0.0):
    """Beams from (0, y, 0) to a wall across the road."""
    y, z = np.meshgrid(np.arange(-6, 6, 0.05), np.arange(-2, 2, 0.05))
    ends = np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], axis=1)
    pose = geometry.pose_from_xyyaw(0.0, y_m, 0.0)
    fired = geometry.transform_points(geometry.inverse(pose), ends)
    return FiredSweep(fired, np.full(len(fired), 0.5), np.stack([pose, pose])), ends


def beams_of(sweeps):
    fired = [wall_sweep(y_m=0.1 * k) for k in range(sweeps)]
    return RecordedBeams([sweep for sweep, _ in fired], np.concatenate([ends for _, ends in fired]))


def test_free_space_is_where_three_beams_passed_away_from_surfaces():
    points = np.array([[10.0, 0, 0], [19.7, 0, 0], [21.5, 0, 0], [10.0, 9.0, 0], [45.0, 0, 0]])
    assert beams_of(3).free(points).tolist() == [True, False, False, False, False]
    assert not beams_of(2).free(points).any()
    fired = [wall_sweep(y_m=0.1 * k)[0] for k in range(3)]
    beside = RecordedBeams(fired, np.array([[10.3, 0, 0]]))  # all beams pass, but something was met 0.3 m away
    assert beside.free(np.array([[10.0, 0, 0], [9.8, 0, 0]])).tolist() == [False, True]


def test_returns_inside_boxes_of_movers_do_not_count():
    path = Trajectory(np.array([0, 10]), np.stack([geometry.pose_from_xyyaw(10.0, 0.0, 0.0)] * 2))
    tracks = [Track("a", sorted(MOVABLE_LABELS)[0], (4.0, 2.0, 1.5), path, True)]
    points = np.array([[10.0, 0, 0], [5.0, 0, 0]])
    assert false_obstacles(points, beams_of(3), [], 5) == (2, 2)
    assert false_obstacles(points, beams_of(3), tracks, 5) == (1, 1)


def test_a_sweep_fired_on_the_move_is_compared_where_each_beam_was_fired():
    """The sensor goes 4 m while it turns: seen from the middle of the way, points beside it lie 20 degrees off."""
    azimuth = np.linspace(-np.pi, np.pi, 1440, endpoint=False) + 1e-3
    fraction = (azimuth + np.pi) / (2 * np.pi)
    poses = np.stack([geometry.pose_from_xyyaw(0, 0, 0), geometry.pose_from_xyyaw(4.0, 0, 0)])
    blocked = np.abs(azimuth - 1.5) < 0.05  # one narrow thing at 4 m, to the left, late in the turn
    reach = np.where(blocked, 4.0, 30.0)
    fired = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1) * reach[:, None]
    beams = RecordedBeams([FiredSweep(fired, fraction, poses)], np.zeros((1, 3)))
    at = 4.0 * (1.5 + np.pi) / (2 * np.pi)
    behind = np.array([[at + 8 * np.cos(1.5), 8 * np.sin(1.5), 0.0]])
    assert beams.passed(behind) == [0]
    assert beams.passed(behind + [2.0, 0, 0]) == [1]


def test_ranges_are_scored_apart():
    xyz = np.array([[5.0, 0, 0], [0, 15.0, 0], [0, 0, 30.0]])
    score = LidarScore(xyz, np.array([5.5, np.nan, 33.0]))
    assert score.within(0, 10).median_abs_error_m == pytest.approx(0.5)
    assert score.within(0, 10).beams == 1
    assert score.within(10, 20).recall == 0


def test_clouds_are_scored_by_the_distances_between_them():
    simulated, recorded = np.array([[5.5, 0, 0], [0, 0, 33.0]]), np.array([[5.0, 0, 0], [0, 15.0, 0], [0, 0, 30.0]])
    # The nearest of (5.5, 0, 0) and (0, 0, 33) are 0.5 and 3 m away; (0, 15, 0) is nearest to (5.5, 0, 0).
    far = np.hypot(15, 5.5)
    figures = CloudScore.of(simulated, recorded).figures()
    assert figures["precision_m"] == pytest.approx((0.5 + 3) / 2)
    assert figures["coverage_m"] == pytest.approx((0.5 + far + 3) / 3)
    assert figures["cd_l1_sum"] == pytest.approx(3.5 / 2 + (3.5 + far) / 3)
    assert figures["cd_l2sq_sum"] == pytest.approx(9.25 / 2 + (9.25 + far**2) / 3)
    assert figures["cd_l2sq_gtnorm"] == pytest.approx((9.25 + 9.25 + far**2) / 3)
    assert figures["count_ratio"] == pytest.approx(2 / 3)
    near = CloudScore.of(recorded + [0.07, 0, 0], recorded).figures()
    assert (near["fscore@0.05"], near["fscore@0.10"], near["fscore@0.20"]) == (0, 1, 1)
    assert np.isnan(CloudScore.of(np.zeros((0, 3)), recorded).figures()["cd_l1_sum"])


def test_errors_on_grazing_ground_are_also_given_along_its_normal():
    """Beams at 3 degrees below the horizon, ground 2 m below, simulated 0.03 m too high; beside it a wall at 10 m."""
    elevation, azimuth = np.meshgrid(np.radians(np.arange(-4, -2, 0.2)), np.radians(np.arange(-20, 20, 0.2)))
    down = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    ground = (down * (2.0 / -down[..., 2:])).reshape(-1, 3)
    wall = (down * (10.0 / down[..., :1])).reshape(-1, 3) * (1, 1, -1)
    xyz = np.concatenate([ground, wall])
    surface = surfaces_of(xyz, np.array([0.0, 0, 1]), np.zeros(len(xyz), bool))
    level = np.arange(len(xyz)) < len(ground)
    assert np.mean(surface.kind[level] == KINDS.index("ground")) > 0.95
    assert np.mean(surface.kind[~level] == KINDS.index("standing")) > 0.95
    distance = np.linalg.norm(xyz, axis=1)
    score = LidarScore(xyz, np.where(level, distance * (1.97 / 2.0), distance + 0.04), None, surface)
    on_ground = score.on("ground")
    assert np.median(on_ground.abs_perpendicular_m) == pytest.approx(0.03, abs=0.001)
    assert on_ground.median_abs_error_m > 0.4
    assert score.on("standing").median_abs_error_m == pytest.approx(0.04)
    moving = surfaces_of(xyz, np.array([0.0, 0, 1]), level)
    assert (moving.kind[level] == KINDS.index("actors")).all()


def test_points_of_one_row_and_of_a_tree_fix_no_plane():
    azimuth = np.radians(np.arange(0, 90, 0.2))
    row = np.column_stack([10 * np.cos(azimuth), 10 * np.sin(azimuth), -0.5 * np.ones_like(azimuth)])
    tree = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) + (0, -8, 1)
    for xyz in (row, tree):
        kind = surfaces_of(xyz, np.array([0.0, 0, 1]), np.zeros(len(xyz), bool)).kind
        assert np.mean(kind == KINDS.index("rough")) > 0.9


def street():
    return Street(frames=6, cameras=(camera("left", 0.25), camera("right", -0.25)))


def test_every_third_image_is_held_out_with_the_sweeps_of_its_time():
    clip = street()
    held = hold_out(clip, ["left"], images_every=3)
    assert held.images == {"left": {2, 5}}
    times = clip.camera_times_us("left")[[2, 5]]
    spins = clip.sweep_times_us("top")
    overlap = {k for k, (a, b) in enumerate(spins) if any(a <= end and b >= start for start, end in times)}
    assert held.sweeps == overlap and overlap
    mask = np.zeros((96, 192), bool)
    clip.ego_mask = lambda camera_id: mask
    seen = without_images(clip, held)
    assert seen.ego_mask("left") is mask
    assert len(seen.camera_times_us("left")) == 4 and len(seen.camera_times_us("right")) == 6
    assert np.array_equal(seen.image("left", 2), clip.image("left", 3))
    assert without_images(clip, hold_out(clip, [])) is clip


def test_holding_out_everything_or_less_than_nothing_is_refused():
    with pytest.raises(ReconstructError, match=r"images_every must be 0 \(none\) or at least 2, got 1"):
        hold_out(street(), ["left"], images_every=1)
    with pytest.raises(ReconstructError, match="camera 'left' has 6 images, none to hold out when every 9th is"):
        hold_out(street(), ["left"], images_every=9)


def test_outlines_end_though_a_lens_sends_their_corners_billions_of_pixels_away():
    """A bus beside the camera: its rear is 86 degrees off the axis, where the polynomial is 1e11 pixels from there."""
    lens = Pinhole(fx_px=120, fy_px=120, cx_px=96, cy_px=48, radial=(0.0, 0.0, 20.0, 0.0, 0.0, 0.0))
    wide = dataclasses.replace(camera("left"), lens=lens)
    box = ((20.0, 2.0, 2.0), np.array([12.0, 6.0]))
    clip = Street(frames=2, boxes={"beside": box}, cameras=(wide,))
    clip.tracks[0] = dataclasses.replace(clip.tracks[0], label="automobile")
    mask = actor_mask(clip, image_request(clip, "left", 0))
    assert mask[50, 60] and not mask[:, 70:].any()


def test_lidar_points_in_an_image_have_their_range_and_are_not_hidden():
    clip = street()
    request = image_request(clip, "left", 2)
    points = seen_points(clip, request)
    assert len(points.pixel) > 50 and points.bin.min() >= 0 and points.bin.max() <= 3
    assert not actor_mask(clip, request)[points.pixel[:, 1], points.pixel[:, 0]].any()


@pytest.fixture(scope="module")
def figures():
    clip = street()
    held = hold_out(clip, ["left"], images_every=3)
    scene = reconstruct(without_images(clip, held), "lift", cameras=["left"], hold_out_sweeps=sorted(held.sweeps),
                        settings=SMALL)  # fmt: skip
    return clip, scene, held, score_scene(clip, scene, held, target_cameras=["left", "right"], via_grpc=False)


def test_seen_and_unseen_frames_are_told_apart(figures):
    image = figures[3]["image"]
    assert image["seen"]["frames"] == 4 and image["unseen"]["frames"] == 8
    assert image["seen"]["psnr_db"] > image["unseen"]["psnr_db"] - 1
    unseen = {f"{name}_{k:04d}" for name, frames in (("left", (2, 5)), ("right", range(6))) for k in frames}
    assert set(image["unseen"]["worst"]) <= unseen
    per_frame = image["cameras"]["left"]["per_frame"]["psnr_db"]
    assert image["seen"]["psnr_db"] == pytest.approx(np.mean([per_frame[k] for k in (0, 1, 3, 4)]))


def test_several_cameras_have_their_own_figures():
    octaves = dict.fromkeys(OCTAVES, 1.0)
    frames = [FrameScore(camera, k, True, psnr_db, 0.9, sharpness=octaves)
              for k, (camera, psnr_db) in enumerate([("front", 30.0), ("left", 20.0), ("front", 32.0)])]  # fmt: skip
    rest = {"lidar": None, "free_space": None, "road": None, "counts": {"static": 1, "dynamic": 1}, "seconds": {}}
    for some, expected in ((frames, {"front": "31.00", "left": "20.00"}), (frames[::2], {})):
        rows = figure_rows({"image": {"seen": summarized(some)}, **rest})
        found = {
            row.name.removeprefix("PSNR, ").removesuffix(" (dB)"): row.text for row in rows if "PSNR, " in row.name
        }
        assert found == expected


def test_a_scene_has_few_holes_and_one_without_gaussians_only_holes(figures):
    clip, scene, held, scores = figures
    holes = scores["image"]["seen"]["holes"]
    assert holes.pop("40-80 m") < 0.15, "5 of 46 points"
    assert set(holes.values()) == {0.0}
    none = np.zeros(len(scene.static), bool)
    empty = dataclasses.replace(scene, static=scene.static[none])
    bare = score_scene(clip, empty, held, target_cameras=["right"], via_grpc=False)
    assert all(share == 1 for share in bare["image"]["unseen"]["holes"].values() if share is not None)
    assert bare["counts"]["static"] == 0 < scores["counts"]["static"] == len(scene.static)


def test_no_false_obstacles_on_the_path_but_before_a_board_in_the_way(figures):
    clip, scene, _, scores = figures
    assert scores["free_space"]["false_obstacles"]["0 m"] < 0.02
    board = scene.static[:400]
    y, z = np.meshgrid(np.linspace(-1, 1, 20), np.linspace(0.5, 2.5, 20))
    ahead = clip.ego.at(clip.ego.end_us)[:3, 3] + np.stack([np.full(400, 4.0), y.ravel(), z.ravel()], axis=1)
    board = dataclasses.replace(board, mean_m=ahead, scale_m=np.full((400, 3), 0.1, np.float32),
                                opacity=np.ones(400, np.float32))  # fmt: skip
    from nurec_sim.scene.transform import joined

    blocked = dataclasses.replace(scene, static=joined([scene.static, board]))
    after = score_scene(clip, blocked, target_cameras=["left"], via_grpc=False)["free_space"]["false_obstacles"]
    assert after["0 m"] > scores["free_space"]["false_obstacles"]["0 m"] + 0.01


def test_false_obstacles_are_looked_for_on_both_sides_of_the_path_and_added_up(monkeypatch):
    clip, places, found = street(), [], iter([(1, 4), (2, 4)] + [(0, 4)] * 12)

    def sense(requests):
        (request,) = requests
        car = clip.ego.at(request.start_us) @ clip.rig.lidars["top"].rig_from_lidar
        places.append(geometry.inverse(car) @ request.world_from_sensor[0])
        nothing = np.zeros(0, np.float32)
        return [LidarFrame(request.sensor, request.start_us, request.end_us, np.zeros((0, 3), np.float32), nothing,
                           nothing, nothing.astype(np.int32))]  # fmt: skip

    monkeypatch.setattr(lidar_scores, "SCANS", 2)
    monkeypatch.setattr(lidar_scores, "false_obstacles", lambda *given: next(found))
    shares = lidar_scores.score_free_space(clip, sense, lambda stage, fraction: None)["false_obstacles"]
    assert shares == {"0 m": 3 / 8, "1 m": 0.0, "2 m": 0.0, "3 m": 0.0}
    assert sorted(pose[1, 3].round(6) for pose in places) == sorted([-3, -2, -1, 0, 1, 2, 3] * 2)
    assert all(np.allclose(pose[[0, 2], 3], 0) and np.allclose(pose[:3, :3], np.eye(3)) for pose in places)


def test_beams_that_did_not_start_where_the_log_says_contradict_its_own_returns(monkeypatch):
    """The same returns, said to be seen from 4 m behind the left wall: beams to the right cross that wall's returns."""
    clip, behind = street(), geometry.pose_from_xyyaw(0.0, 12.0, 0.0)
    measured, reports = clip.sweep, []

    def nothing(requests):
        none = np.zeros(0, np.float32)
        return [LidarFrame(r.sensor, r.start_us, r.end_us, np.zeros((0, 3), np.float32), none, none,
                           none.astype(np.int32)) for r in requests]  # fmt: skip

    def elsewhere(lidar, index):
        sweep = measured(lidar, index)
        xyz = geometry.transform_points(geometry.inverse(behind), sweep.xyz_m)
        return dataclasses.replace(sweep, xyz_m=xyz, world_from_lidar=sweep.world_from_lidar @ behind)

    for sweep in (measured, elsewhere):
        clip.sweep = sweep
        reports.append(lidar_scores.score_free_space(clip, nothing, lambda stage, fraction: None))
    true, wrong = (report["recorded_in_free_space"] for report in reports)
    assert true == 0 and wrong > 0.03


@pytest.mark.parametrize("via_grpc", [False, True])
def test_frames_come_from_where_they_were_asked_for(figures, via_grpc, monkeypatch):
    class AskedError(Exception):
        pass

    def sensing(scene, *given):
        raise AskedError(given)

    monkeypatch.setattr(log, "sensing", sensing)
    with pytest.raises(AskedError) as caught:
        score_scene(figures[0], figures[1], via_grpc=via_grpc, device="cpu")
    assert caught.value.args == ((via_grpc, "cpu"),)


def test_a_scene_of_another_path_is_refused(figures):
    import dataclasses

    _, scene, _, _ = figures
    clip = Street(frames=6, speed_mps=3.0, cameras=(camera("left", 0.25),))
    with pytest.raises(ReconstructError, match="was not made from clip .* paths are .* m apart"):
        score_scene(clip, scene, via_grpc=False)
    late = dataclasses.replace(scene, ego=Trajectory(scene.ego.t_us + 10**9, scene.ego.world_from_body))
    with pytest.raises(ReconstructError, match="is of another time than clip"):
        score_scene(clip, late, via_grpc=False)


def test_a_copied_sweep_tells_the_range_of_its_return_nearest_in_direction():
    def at(azimuth_deg, range_m):
        return range_m[:, None] * np.stack(
            [np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg)), 0 * range_m], axis=1
        )

    recorded = at(np.array([0.0, 10.0, 20.0, 30.0]), np.array([5.0, 8.0, 0.0, 12.0]))
    other = at(np.array([0.9, 10.4, 9.8, 31.2, 50.0]), np.array([5.5, 3.0, 8.25, 12.0, 0.0]))
    score = copied_sweep(recorded, other)
    # The return at no distance has no direction; at 30 degrees the nearest direction is 1.2 degrees off.
    assert score.recorded_m == pytest.approx([5, 8, 12])
    assert score.simulated_m == pytest.approx([5.5, 8.25, np.nan], nan_ok=True)


def test_scores_of_sweeps_have_those_of_the_nearest_seen_sweep_beside_them(monkeypatch):
    clip, asked, copied = Street(frames=6, boxes={"post": ((0.5, 0.5, 2.0), (12.0, 2.0))}, labelled=False), [], []

    def noted(xyz, other, surface):
        copied.append((xyz, other))
        return copied_sweep(xyz, other, surface)

    monkeypatch.setattr(lidar_scores, "copied_sweep", noted)
    measured = clip.sweep
    clip.sweep = lambda lidar, index: asked.append(index) or measured(lidar, index)

    def sense(requests):
        none = np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32)
        return [LidarFrame(request.sensor, request.start_us, request.end_us, *none) for request in requests]

    figures = lidar_scores.score_sweeps(clip, clip.rig.lidars, [1, 2, 4], sense, lambda stage, done: None)
    # 0 is as near to 1 as 2 is, which is held out; 3 is the nearest to 2, and to 4 the first of 3 and 5.
    assert asked == [1, 0, 2, 3, 4, 3]
    # In the frame of the sweep itself, 1 m farther along the road each time: the front of the post is at x = 11.75 m.
    for index, clouds in zip([1, 2, 4], copied, strict=True):
        assert not np.array_equal(*clouds)
        for cloud in clouds:
            post = cloud[(np.abs(cloud[:, 1] - 2) < 0.24) & (cloud[:, 2] > -1)]
            assert post[:, 0].min() == pytest.approx(11.75 - 0.5 - 1.0 * index)
    assert figures["copied"]["return_recall"] > 0.9 > figures["return_recall"] == 0
    assert figures["copied"]["by_range"]["0-10 m"]["median_abs_range_error_m"] < 0.1
    every = range(len(clip.t_us))
    assert lidar_scores.score_sweeps(clip, clip.rig.lidars, every, sense, lambda stage, done: None)["copied"] is None
