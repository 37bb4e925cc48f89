"""Training clips of a small world known in closed form: ground, walls, a van that drives, a car that turns."""

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.training.data.clips import NORMAL_SCALE, CameraRecord, write_training_clip
from nurec_sim.types import CameraModel, Label, Pinhole, Rig, Shutter, Track, Trajectory

START_US, PERIOD_US, FRAMES = 2_000_000, 100_000, 12
WALL_M = 45.0
CAMERA_FROM_RIG_AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
KNOTS_US = np.arange(START_US - 2_000_000, START_US + 4_000_001, 100_000)


def camera(name="camera_front", yaw_deg=0.0, size=(112, 70), lens=None, shutter=Shutter.GLOBAL):
    width, height = size
    lens = lens or Pinhole(0.7 * width, 0.7 * width, 0.51 * width, 0.45 * height)
    turn = geometry.rotation_from_yaw(np.deg2rad(yaw_deg)) @ CAMERA_FROM_RIG_AXES
    return CameraModel(name, width, height, lens, geometry.pose(turn, np.array([1.5, 0.0, 1.5])), shutter)


def ego():
    """8 m/s and a slow turn to the left."""
    seconds = (KNOTS_US - START_US) / 1e6
    poses = [geometry.pose_from_xyyaw(8 * s, 0.4 * s * s, 0.1 * s) for s in seconds]
    return Trajectory(KNOTS_US, np.array(poses))


def tracks():
    """A van that drives straight on at 5 m/s, and a car that turns on the spot."""
    seconds = (KNOTS_US - START_US) / 1e6
    van = [geometry.pose_from_xyyaw(14 + 5 * s, 3.0, 0.0, 1.1) for s in seconds]
    car = [geometry.pose_from_xyyaw(17.0, -4.0, 0.8 * s, 0.8) for s in seconds]
    return (
        Track("van", "automobile", (5.0, 2.0, 2.2), Trajectory(KNOTS_US, np.array(van))),
        Track("car", "automobile", (4.4, 1.8, 1.6), Trajectory(KNOTS_US, np.array(car))),
    )


def write_clip(folder, cameras=None, readout_us=30_000, frames=FRAMES):
    """A clip in ``folder`` whose depth is exact to half precision."""
    cameras = (camera(),) if cameras is None else cameras
    first = START_US + PERIOD_US * np.arange(frames)
    records = []
    for model in cameras:
        last = first if model.shutter is Shutter.GLOBAL else first + readout_us
        records.append(_record(model, np.stack([first, last], axis=1)))
    facts = {"plan_sha256": folder.name}
    return write_training_clip(folder, Rig({c.id: c for c in cameras}, {}), ego(), tracks(), records, facts)


def _record(model, exposures):
    poses = ego().at(exposures.reshape(-1)).reshape(-1, 2, 4, 4) @ model.rig_from_camera
    views = [_view(model, times, pair) for times, pair in zip(exposures, poses, strict=True)]
    rgb, label, depth, normal, instance = (np.stack(arrays) for arrays in zip(*views, strict=True))
    return CameraRecord(exposures, poses, rgb, label, depth, normal, instance)


def _view(model, times, pair):
    rays, valid = sensors.pixel_rays(model)
    assert valid.all()
    v, u = np.mgrid[: model.height_px, : model.width_px] + 0.5
    fraction = sensors.shutter_fraction(model, np.stack([u, v], axis=-1).reshape(-1, 2))
    taken_us = times[0] + np.rint(fraction * (times[1] - times[0])).astype(np.int64)
    poses = geometry.interpolate_pose_pair(pair, fraction)
    local = rays.reshape(-1, 3)
    direction, origin = np.einsum("nij,nj->ni", poses[:, :3, :3], local), poses[:, :3, 3]
    distance, instance, normal, where = _cast(origin, direction, taken_us)
    hit = np.isfinite(distance)
    colour = 0.5 + 0.4 * np.sin(0.5 * where + [0.0, 1.0, 2.0] + instance[:, None])
    rgb = np.where(hit[:, None], colour, (0.5, 0.7, 0.9)) * 255
    label = np.where(hit, np.where(instance > 0, Label.MOVABLE, Label.OTHER), Label.SKY)
    label[hit & (normal[:, 2] > 0.99) & (instance == 0)] = Label.ROAD
    depth = np.where(hit, distance * local[:, 2], 0)
    normal = np.einsum("nji,nj->ni", poses[:, :3, :3], normal) * NORMAL_SCALE
    size = (model.height_px, model.width_px)
    return (np.rint(rgb).astype(np.uint8).reshape(*size, 3), label.astype(np.uint8).reshape(size),
            depth.astype(np.float16).reshape(size), np.rint(normal).astype(np.int8).reshape(*size, 3),
            instance.astype(np.uint16).reshape(size))  # fmt: skip


def _cast(origin, direction, taken_us):
    """Distance (inf: sky), track number, world normal, and the place on what was hit that decides its colour."""
    count = len(direction)
    best, instance = np.full(count, np.inf), np.zeros(count, int)
    normal, where = np.zeros((count, 3)), np.zeros((count, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, at, up in ((2, 0.0, 1.0), (0, WALL_M, -1.0), (1, WALL_M, -1.0), (1, -WALL_M, 1.0)):
            t = (at - origin[:, axis]) / direction[:, axis]
            hit = (t > 0) & (t < best) & ((origin + t[:, None] * direction)[:, 2] < 9.0)
            best[hit], normal[hit] = t[hit], up * np.eye(3)[axis]
    flat = np.isfinite(best)
    where[flat] = (origin + best[:, None] * direction)[flat]
    for number, track in enumerate(tracks(), 1):
        box_from_world = geometry.inverse(track.path.at(taken_us))
        start = np.einsum("nij,nj->ni", box_from_world[:, :3, :3], origin) + box_from_world[:, :3, 3]
        ray = np.einsum("nij,nj->ni", box_from_world[:, :3, :3], direction)
        half = np.array(track.size_m) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = (-half - start) / ray, (half - start) / ray
        near = np.minimum(low, high)
        enter, leave = near.max(axis=1), np.maximum(low, high).min(axis=1)
        hit = (enter < leave) & (enter > 0) & (enter < best)
        axis = near.argmax(axis=1)
        side = -np.sign(ray[np.arange(count), axis])[:, None] * np.eye(3)[axis]
        best[hit], instance[hit] = enter[hit], number
        normal[hit] = np.einsum("nji,nj->ni", box_from_world[:, :3, :3], side)[hit]
        where[hit] = (start + enter[:, None] * ray)[hit]
    return best, instance, normal, where
