"""From the network's tensors to layers of the world, with outputs made by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from nurec_sim import geometry, sensors
from nurec_sim.network.tensors import ContextMaps, NetworkInputs, NetworkOutputs, QueryGaussians, SemanticClass
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ContextImage
from nurec_sim.reconstruct.feedforward.layers import COVERED_WEIGHT, MIN_DYNAMIC_OPACITY, chunk_layers
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.reconstruct.feedforward.tracks.standing import standing_pixels
from nurec_sim.types import CameraModel, Label, Pinhole, Shutter, Track, Trajectory

EPOCH_US = 1_550_000_000_000_000
WIDTH, HEIGHT, GAP_US, EXPOSURE_US = 28, 14, 500_000, 27_000
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
SETTINGS = FeedForwardSettings(sky_px=8)


def camera(name="front", yaw=0.0):
    rig_from_camera = geometry.pose(geometry.rotation_from_yaw(yaw) @ FORWARD, np.array([1.5, 0.2, 1.4]))
    lens = Pinhole(20.0, 21.0, WIDTH / 2 + 0.3, HEIGHT / 2)
    return CameraModel(name, WIDTH, HEIGHT, lens, rig_from_camera, Shutter.TOP_TO_BOTTOM)


CAMERAS = (camera(), camera("left", 0.9))


class Drive:
    """A log of a car that drives 10 m/s along a heading of 0.4 rad; two frames of each of two cameras make a chunk."""

    def __init__(self, start_us=2_000_000, tracks=(), cameras=CAMERAS, frames=2):
        self.start_us, self.tracks = start_us, tuple(tracks)
        self.span_us = (start_us, start_us + 4_000_000)
        self.images = tuple(self._image(c, k, frames) for c in cameras for k in range(frames))
        self.world_from_scene = self.images[0].world_from_camera[1]

    def _image(self, camera, k, frames):
        t = self.start_us + 1_000_000 + k * GAP_US + (7_000 if camera.id == "left" else 0)
        t_us = (t, t + EXPOSURE_US)
        poses = [
            geometry.pose_from_xyyaw(100 + 9.2 * s, 50 + 3.9 * s, 0.4)
            for s in (np.array(t_us) - self.start_us) / 1e6 - 1
        ]
        centre = sum(t_us) // 2
        return ContextImage(camera, k, t_us, (centre - GAP_US, centre + GAP_US),
                            np.stack([pose @ camera.rig_from_camera for pose in poses]))  # fmt: skip

    def rays(self, image):
        """Origins and directions in the world, each pixel at its own time."""
        direction, valid = sensors.pixel_rays(image.camera)
        assert valid.all()
        fraction = np.arange(HEIGHT) / (HEIGHT - 1)
        poses = geometry.interpolate_pose_pair(image.world_from_camera, fraction)
        turned = np.einsum("hij,hwj->hwi", poses[:, :3, :3], direction)
        return np.broadcast_to(poses[:, None, :3, 3], turned.shape), turned

    def times(self, image):
        """When each pixel was exposed."""
        line = image.t_us[0] + np.rint(np.arange(HEIGHT) / (HEIGHT - 1) * EXPOSURE_US).astype(np.int64)
        return np.repeat(line[:, None], WIDTH, axis=1)

    def chunk(self, ego=None):
        scene_from_world = geometry.inverse(self.world_from_scene)
        rays = []
        for image in self.images:
            origin, direction = self.rays(image)
            rays.append(np.concatenate([geometry.transform_points(scene_from_world, origin),
                                        direction @ scene_from_world[:3, :3].T], axis=-1))  # fmt: skip
        v = len(self.images)
        zeros = torch.zeros(1, v)
        names = list(dict.fromkeys(image.camera.id for image in self.images))
        tensors = NetworkInputs(
            rgb=torch.full((1, v, HEIGHT, WIDTH, 3), 0.5),
            c2w=torch.eye(4).expand(1, v, 4, 4),
            fov=torch.ones(1, v, 2),
            rays=torch.from_numpy(np.stack(rays)[None]).float(),
            distance_to_depth_scale=torch.ones(1, v, HEIGHT, WIDTH, 1),
            camera_idxs=torch.tensor([[names.index(image.camera.id) for image in self.images]]),
            time=zeros,
            time_before=zeros,
            time_after=zeros,
        )
        ego = np.zeros((v, HEIGHT, WIDTH), bool) if ego is None else ego
        return ChunkInputs(0, self.span_us, self.images, self.world_from_scene, tensors, ego)


def outputs(drive, depth_m=12.0, semantic=SemanticClass.OTHERS, opacity=0.5, motion_world=((-1.0, 0, 0), (1.0, 0, 0))):
    """What the network would say of walls at ``depth_m`` along the rays; all arguments broadcast over pixels."""
    v, n = len(drive.images), len(drive.images) * HEIGHT * WIDTH
    rng = np.random.default_rng(0)
    scene_from_world = geometry.inverse(drive.world_from_scene)
    pairs = [drive.rays(image) for image in drive.images]
    distance = np.broadcast_to(depth_m, (v, HEIGHT, WIDTH))[..., None]
    world = np.stack([origin for origin, _ in pairs]) + distance * np.stack([direction for _, direction in pairs])
    position = geometry.transform_points(scene_from_world, world.reshape(-1, 3))
    motion = np.broadcast_to(np.asarray(motion_world, float), (n, 2, 3)) @ scene_from_world[:3, :3].T
    quat = rng.normal(size=(n, 4))
    normal = rng.normal(size=(n, 3))

    def tensor(values, *shape):
        return torch.from_numpy(np.broadcast_to(np.asarray(values, np.float32), (n, *shape)).copy())[None]

    gaussians = QueryGaussians(
        position_m=tensor(position, 3),
        quat_wxyz=tensor(quat / np.linalg.norm(quat, axis=1, keepdims=True), 4),
        scale_m=tensor(rng.uniform(0.01, 0.3, (n, 3)), 3),
        opacity=tensor(np.broadcast_to(opacity, (v, HEIGHT, WIDTH)).reshape(-1)),
        rgb=tensor(rng.random((n, 3)), 3),
        normal=tensor(normal / np.linalg.norm(normal, axis=1, keepdims=True), 3),
        semantic=tensor(np.broadcast_to(semantic, (v, HEIGHT, WIDTH)).reshape(-1)).long(),
        source=torch.arange(n)[None],
        motion_m=tensor(motion, 2, 3),
    )
    shape = (1, v, HEIGHT, WIDTH)
    context = ContextMaps(torch.ones(shape), torch.ones(*shape, 3), torch.ones(*shape, 3), torch.zeros(*shape, 5), None)
    isp = torch.from_numpy(rng.normal(size=(1, 2, 3, 4)).astype(np.float32))
    return NetworkOutputs(
        context, gaussians, torch.full((1, 6, 14, 14, 3), 0.4), torch.ones(1, 6, 14, 14, 1), True, isp
    )


def changed(result, **fields):
    return dataclasses.replace(result, gaussians=dataclasses.replace(result.gaussians, **fields))


def classes(drive, **where):
    """A map of classes: OTHERS, and each named class at the given index."""
    result = np.full((len(drive.images), HEIGHT, WIDTH), int(SemanticClass.OTHERS))
    for name, index in where.items():
        result[index] = int(SemanticClass[name])
    return result


def wall(drive, **kwargs):
    """World positions of all pixels, in order."""
    result = outputs(drive, **kwargs).gaussians.position_m[0].double().numpy()
    return geometry.transform_points(drive.world_from_scene, result)


def vehicle(drive, middle=(111.5, 53.0, 1.0), velocity=(0.0, 0.0), size=(6.0, 6.0, 6.0), yaw=0.4):
    """A labelled box, where ``middle`` is at 1.25 s."""
    t_us = drive.span_us[0] + 100_000 * np.arange(41)
    poses = [geometry.pose_from_xyyaw(middle[0] + velocity[0] * s, middle[1] + velocity[1] * s, yaw, middle[2])
             for s in (t_us - drive.span_us[0]) / 1e6 - 1.25]  # fmt: skip
    return Track("car", "automobile", size, Trajectory(t_us, np.stack(poses)))


# ------------------------------------------------------------------------------------------------------- geometry


def test_everything_is_turned_from_the_scene_frame_to_the_world():
    drive = Drive()
    result = outputs(drive)
    layers = chunk_layers(drive, drive.chunk(), result, SETTINGS)
    given, static = result.gaussians, layers.static
    assert len(static) == 4 * HEIGHT * WIDTH and len(layers.dynamic) == 0
    assert np.abs(static.mean_m - wall(drive)).max() < 1e-4
    turn = drive.world_from_scene[:3, :3]
    expected = turn @ geometry.matrix_from_quat(given.quat_wxyz[0].double().numpy())
    assert np.abs(geometry.matrix_from_quat(static.quat_wxyz) - expected).max() < 1e-5
    assert (static.quat_wxyz[:, 0] >= 0).all() and np.allclose(np.linalg.norm(static.quat_wxyz, axis=1), 1)
    assert np.abs(static.normal - given.normal[0].numpy() @ turn.T).max() < 1e-6
    for name in ("rgb", "scale_m", "opacity"):
        assert np.array_equal(getattr(static, name), getattr(given, name)[0].numpy())
    assert np.isnan(static.intensity).all()
    for array in vars(static).values():
        assert array is None or array.dtype in (np.float32, np.uint8)


def test_positions_keep_their_millimetres_far_from_the_origin():
    drive = Drive()
    shift = np.array([5_000.0, -8_000.0, 300.0])
    far = drive.world_from_scene.copy()
    far[:3, 3] += shift
    near = chunk_layers(drive, drive.chunk(), outputs(drive), SETTINGS).static.mean_m
    moved = chunk_layers(drive, dataclasses.replace(drive.chunk(), world_from_scene=far), outputs(drive), SETTINGS)
    assert np.abs(moved.static.mean_m - (near + shift)).max() < 1e-3


def test_labels_follow_the_classes():
    drive = Drive()
    semantic = classes(drive, EGO=(0, 0), SKY=(0, 1), ROAD=(0, 2), MOVABLE=(0, 3))
    layers = chunk_layers(drive, drive.chunk(), outputs(drive, semantic=semantic), SETTINGS)
    rows = layers.static.label[: HEIGHT * WIDTH - WIDTH].reshape(HEIGHT - 1, WIDTH)  # without the movable row
    assert [set(row.tolist()) for row in rows[:4]] == [{Label.EGO}, {Label.SKY}, {Label.ROAD}, {Label.OTHER}]
    assert len(layers.dynamic) == WIDTH and (layers.dynamic.gaussians.label == Label.MOVABLE).all()


def test_camera_responses_and_sky():
    drive = Drive()
    result = outputs(drive)
    layers = chunk_layers(drive, drive.chunk(), result, SETTINGS)
    assert list(layers.isp) == ["front", "left"]
    assert all(np.array_equal(layers.isp[name], result.isp[0, k].numpy()) for k, name in enumerate(layers.isp))
    assert layers.isp["left"].dtype == np.float64
    unlooked = layers.sky_seen == 0
    assert layers.sky.shape == (6, 8, 8, 3) and unlooked.mean() > 0.5 and np.allclose(layers.sky[unlooked], 0.4)
    observed = chunk_layers(drive, drive.chunk(), result, dataclasses.replace(SETTINGS, learned_sky=False))
    assert observed.sky.shape == (6, 8, 8, 3) and observed.sky_seen.max() < 0.2  # no pixel is sky
    assert layers.images == drive.images


def test_the_sky_that_images_show_replaces_the_learned_one_where_they_show_it():
    drive = Drive()
    result = outputs(drive)
    logits = torch.zeros_like(result.context.logits)
    logits[..., SemanticClass.SKY] = 10
    context = dataclasses.replace(result.context, logits=logits, rgb=torch.full_like(result.context.rgb, 0.7))
    layers = chunk_layers(drive, drive.chunk(), dataclasses.replace(result, context=context), SETTINGS)
    shown = layers.sky_seen > 0.9 * layers.sky_seen.max()
    assert shown.any() and np.allclose(layers.sky[shown], 0.7)
    elsewhere = layers.sky_seen == 0
    assert elsewhere.any() and np.allclose(layers.sky[elsewhere], 0.4)


def test_behind_surfaces_lies_their_own_colour_and_counts_less_than_a_sky_that_others_see():
    drive = Drive()
    result = outputs(drive)
    sky = chunk_layers(drive, drive.chunk(), result, SETTINGS).sky
    logits = result.context.logits.clone()
    logits[..., SemanticClass.SKY] = 10
    context = dataclasses.replace(result.context, rgb=torch.full_like(result.context.rgb, 0.7))
    covered = chunk_layers(drive, drive.chunk(), dataclasses.replace(result, context=context), SETTINGS)
    behind = covered.sky_seen > 0
    assert np.allclose(covered.sky[behind], 0.7, atol=1e-5) and np.allclose(covered.sky_seen[behind], COVERED_WEIGHT)
    assert behind.any() and np.array_equal(covered.sky[~behind], sky[~behind])
    # The car's own pixels say nothing of what is behind them.
    hidden = drive.chunk(ego=np.ones((4, HEIGHT, WIDTH), bool))
    assert not chunk_layers(drive, hidden, dataclasses.replace(result, context=context), SETTINGS).sky_seen.any()


# -------------------------------------------------------------------------------------------------------- pruning


def test_faint_and_broken_gaussians_are_dropped():
    drive = Drive()
    opacity = np.full((4, HEIGHT, WIDTH), 0.5)
    opacity[0, 0, :4] = [0.0, 0.01, 0.0101, 0.02]
    result = outputs(drive, opacity=opacity, semantic=classes(drive, MOVABLE=(3, -1)))
    for k, name in enumerate(("position_m", "quat_wxyz", "scale_m", "rgb", "normal")):
        getattr(result.gaussians, name)[0, WIDTH + k, 0] = (np.nan, np.inf)[k % 2]
    result.gaussians.opacity[0, WIDTH + 5] = np.nan
    result.gaussians.quat_wxyz[0, WIDTH + 6] = 0
    result.gaussians.motion_m[0, -1, 1, 2] = np.nan
    layers = chunk_layers(drive, drive.chunk(), result, SETTINGS)
    assert len(layers.static) == (4 * HEIGHT - 1) * WIDTH - 2 - 7
    assert len(layers.dynamic) == WIDTH - 1
    assert layers.static.opacity[0] == np.float32(0.0101)
    assert all(np.isfinite(values).all() for values in (layers.static.mean_m, layers.static.quat_wxyz))
    few = chunk_layers(drive, drive.chunk(), result, dataclasses.replace(SETTINGS, min_opacity=0.5))
    assert len(few.static) == len(few.dynamic) == 0


def test_defect_8_pixels_of_the_ego_mask_are_dropped():
    drive = Drive()
    ego = np.zeros((4, HEIGHT, WIDTH), bool)
    ego[1, -3:] = True
    ego[3, :, 0] = True
    result = outputs(drive, semantic=classes(drive, MOVABLE=(slice(None), slice(10, None))))
    layers = chunk_layers(drive, drive.chunk(ego), result, SETTINGS)
    kept = np.concatenate([layers.static.mean_m, layers.dynamic.gaussians.mean_m])
    expected = wall(drive)[~ego.reshape(-1)]
    assert len(kept) == len(expected) == ego.size - 3 * WIDTH - HEIGHT
    assert np.allclose(np.sort(kept[:, 0]), np.sort(expected[:, 0].astype(np.float32)), atol=1e-4)


# --------------------------------------------------------------------------------------------- static and dynamic


def test_movable_points_move_as_the_motion_head_says():
    drive = Drive()
    semantic = classes(drive, MOVABLE=(slice(None), slice(3, 7), slice(5, 9)))
    motion = ((-2.0, 0.5, 0.0), (1.5, -0.25, 0.1))
    result = outputs(drive, semantic=semantic, motion_world=motion, opacity=0.2)
    layers = chunk_layers(drive, drive.chunk(), result, SETTINGS)
    dynamic, movable = layers.dynamic, (semantic == SemanticClass.MOVABLE).reshape(-1)
    assert len(dynamic) == movable.sum() == 64 and len(layers.static) == (~movable).sum()
    assert np.allclose(dynamic.gaussians.mean_m, wall(drive)[movable], atol=1e-4)
    assert np.array_equal(dynamic.knot_m[:, 1], dynamic.gaussians.mean_m)
    assert np.allclose(dynamic.knot_m[:, 0] - dynamic.knot_m[:, 1], motion[0], atol=1e-4)
    assert np.allclose(dynamic.knot_m[:, 2] - dynamic.knot_m[:, 1], motion[1], atol=1e-4)
    assert (dynamic.track == -1).all() and (dynamic.gaussians.opacity == np.float32(MIN_DYNAMIC_OPACITY)).all()
    expected = np.concatenate([drive.times(image).reshape(-1) for image in drive.images])[movable]
    assert np.array_equal(dynamic.knot_t_us[:, 1], expected)
    targets = np.repeat([image.target_t_us for image in drive.images], 16, axis=0)
    assert np.array_equal(dynamic.knot_t_us[:, [0, 2]], targets)


def test_without_a_motion_head_movable_points_stand_between_their_knots():
    drive = Drive()
    result = changed(outputs(drive, semantic=SemanticClass.MOVABLE), motion_m=None)
    dynamic = chunk_layers(drive, drive.chunk(), result, SETTINGS).dynamic
    assert len(dynamic) == 4 * HEIGHT * WIDTH and np.ptp(dynamic.knot_m, axis=1).max() == 0


@pytest.mark.parametrize("tracks", [(), ("far",)])
def test_defect_3_movable_points_are_dynamic_whether_tracks_explain_them_or_not(tracks):
    """The release drops the semantic split as soon as a track set, though an empty one, is given."""
    drive = Drive(tracks=[vehicle(Drive(), middle=(100.0, -900.0, 1.0)) for _ in tracks])
    layers = chunk_layers(drive, drive.chunk(), outputs(drive, semantic=SemanticClass.MOVABLE), SETTINGS)
    assert len(layers.static) == 0 and len(layers.dynamic) == 4 * HEIGHT * WIDTH
    assert (layers.dynamic.track == -1).all() and np.ptp(layers.dynamic.knot_m, axis=1).min(axis=1).max() < 1e-5


@pytest.mark.parametrize("start_us", [2_000_000, EPOCH_US])
def test_defect_2_points_in_a_box_follow_its_track_on_any_clock(start_us):
    drive = Drive(start_us)
    velocity = np.array([8.0, 3.0])
    cone, car = dataclasses.replace(vehicle(drive), label="traffic_cone", id="cone"), vehicle(drive, velocity=velocity)
    drive.tracks = (cone, car)
    layers = chunk_layers(drive, drive.chunk(), outputs(drive, depth_m=10.0), SETTINGS)
    position = wall(drive, depth_m=10.0)
    times = np.concatenate([drive.times(image).reshape(-1) for image in drive.images])
    box_from_world = geometry.inverse(car.path.at(times))
    in_box = np.einsum("nij,nj->ni", box_from_world[:, :3, :3], position) + box_from_world[:, :3, 3]
    inside = geometry.points_in_box(in_box, car.size_m)
    assert 100 < inside.sum() < len(inside)
    dynamic = layers.dynamic
    assert len(dynamic) == inside.sum() and (dynamic.track == 1).all()
    assert (dynamic.gaussians.label == Label.MOVABLE).all()
    assert np.allclose(dynamic.gaussians.mean_m, position[inside], atol=1e-4)
    for k in range(3):
        passed_s = (dynamic.knot_t_us[:, k] - dynamic.knot_t_us[:, 1])[:, None] / 1e6
        assert np.allclose(dynamic.knot_m[:, k, :2], position[inside][:, :2] + velocity * passed_s, atol=1e-3)


def test_the_road_under_a_car_stays_where_it_is():
    drive = Drive()
    drive.tracks = (vehicle(drive, velocity=(8.0, 3.0)),)
    semantic = classes(drive, ROAD=(slice(None), slice(8, None)))
    layers = chunk_layers(drive, drive.chunk(), outputs(drive, depth_m=10.0, semantic=semantic), SETTINGS)
    assert len(layers.dynamic) and (layers.static.label == Label.ROAD).sum() == (semantic == SemanticClass.ROAD).sum()


def test_movable_points_with_a_wrong_depth_find_their_box_by_ray():
    drive = Drive()
    drive.tracks = (vehicle(drive, velocity=(8.0, 3.0), size=(3.0, 2.0, 2.0)),)
    right = chunk_layers(drive, drive.chunk(), outputs(drive, 10.0, SemanticClass.MOVABLE), SETTINGS).dynamic
    wrong = chunk_layers(drive, drive.chunk(), outputs(drive, 25.0, SemanticClass.MOVABLE), SETTINGS).dynamic
    still = chunk_layers(drive, drive.chunk(), outputs(drive, 25.0, SemanticClass.OTHERS), SETTINGS).dynamic
    assert len(still) == 0 and len(right) == len(wrong) == 4 * HEIGHT * WIDTH
    assert ((right.track == 0) <= (wrong.track == 0)).all() and 20 < (wrong.track == 0).sum() < len(wrong)
    mine = wrong.track == 0
    passed_s = (wrong.knot_t_us[mine, 2] - wrong.knot_t_us[mine, 1])[:, None] / 1e6
    assert np.allclose(
        (wrong.knot_m[mine, 2] - wrong.knot_m[mine, 1])[:, :2], np.array([8.0, 3.0]) * passed_s, atol=1e-3
    )


@pytest.mark.parametrize("semantic", [SemanticClass.OTHERS, SemanticClass.MOVABLE])
def test_points_of_a_standing_car_stay_over_the_whole_clip_unless_images_disagree_on_them(semantic):
    """Those that the consensus left movable are shown for the moment of their image only."""
    drive = Drive()
    drive.tracks = (vehicle(drive),)
    dynamic = chunk_layers(drive, drive.chunk(), outputs(drive, 10.0, semantic), SETTINGS).dynamic
    mine = dynamic.track == 0
    assert mine.any() and np.ptp(dynamic.knot_m[mine], axis=1).max() == 0
    first_us, last_us = dynamic.knot_t_us[mine, 0], dynamic.knot_t_us[mine, 2]
    if semantic == SemanticClass.OTHERS:
        assert (first_us < drive.span_us[0]).all() and (last_us > drive.span_us[1]).all()
    else:
        assert (last_us - first_us <= 2 * GAP_US + EXPOSURE_US).all()


def test_pixels_that_show_what_stands():
    """In or behind a box that stands; and, if a log has boxes, what lies in none and moves less than 0.5 m/s."""
    drive = Drive()
    standing, moving = vehicle(drive), vehicle(drive, velocity=(8.0, 3.0), size=(3.0, 2.0, 2.0))
    semantic = np.full((4, HEIGHT, WIDTH), int(SemanticClass.MOVABLE))
    semantic[:, -2:] = SemanticClass.ROAD
    depth_m, still = np.full((4, HEIGHT, WIDTH), 10.0, np.float32), torch.zeros(1, 4, HEIGHT, WIDTH, 2, 3)

    def found(tracks, speed_mps, depth_m=depth_m, motion=True):
        drive.tracks = tracks
        moves = still.clone()
        moves[..., 1, 0] = speed_mps * 2 * GAP_US / 1e6
        return standing_pixels(drive, drive.chunk(), depth_m, semantic, moves if motion else None)

    movable = semantic == SemanticClass.MOVABLE
    assert not found((), 0.0).any()
    assert (found((standing,), 0.49) == movable).all()
    boxed = found((standing,), 0.51)
    assert 20 < boxed.sum() < movable.sum() and (boxed == found((standing,), 0, motion=False)).all()
    assert (found((standing,), 1.0, np.full_like(depth_m, 40.0)) >= boxed).all(), "by the ray"
    free = found((moving,), 0.0)
    assert 20 < (movable & ~free).sum() < movable.sum() and not found((moving,), 1.0).any()


def test_the_order_of_the_queries_does_not_matter():
    """A selective decoder gives its Gaussians in any order, and not one per pixel."""
    drive = Drive(tracks=[vehicle(Drive(), velocity=(8.0, 3.0), size=(3.0, 2.0, 2.0))])
    semantic = classes(drive, MOVABLE=(slice(None), slice(2, 10), slice(3, 20)), ROAD=(slice(None), slice(12, 14)))
    result = outputs(drive, depth_m=10.0, semantic=semantic)
    straight = chunk_layers(drive, drive.chunk(), result, SETTINGS)
    order = torch.from_numpy(np.random.default_rng(1).permutation(4 * HEIGHT * WIDTH))
    fields = {f.name: getattr(result.gaussians, f.name)[:, order] for f in dataclasses.fields(result.gaussians)}
    mixed = chunk_layers(drive, drive.chunk(), changed(result, **fields), SETTINGS)
    assert len(mixed.static) == len(straight.static)

    def rows(dynamic):
        table = np.column_stack([dynamic.knot_m.reshape(-1, 9), dynamic.knot_t_us - drive.start_us, dynamic.track])
        return table[np.lexsort(table.T)]

    assert np.array_equal(rows(mixed.dynamic), rows(straight.dynamic))
    again = chunk_layers(drive, drive.chunk(), result, SETTINGS)
    assert np.array_equal(again.dynamic.knot_m, straight.dynamic.knot_m)
    assert np.array_equal(again.static.mean_m, straight.static.mean_m)


def test_a_chunk_of_one_image():
    drive = Drive(cameras=(camera(),), frames=1)
    result = outputs(drive, semantic=SemanticClass.MOVABLE)
    layers = chunk_layers(drive, drive.chunk(), result, SETTINGS)
    assert len(layers.dynamic) == HEIGHT * WIDTH and list(layers.isp) == ["front"]
    assert (np.diff(layers.dynamic.knot_t_us, axis=1) > 0).all()
