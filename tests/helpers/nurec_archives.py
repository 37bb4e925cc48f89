"""NuRec archives of one made world, and the world itself as a scene, without reading a file."""

import dataclasses

import foreign_files as made
import numpy as np

from nurec_sim import geometry
from nurec_sim.render.cpu.renderer import CpuRenderer
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label, SensorRequest

AT_US = made.START_US + 310_000

SKY = (geometry.cubemap_directions(8) * 0.4 + 0.5).astype(np.float16).astype(np.float32)


def background():
    return made.gaussians(300, 1, [4, -8, 0], [30, 8, 5])


def road():
    return made.gaussians(200, 2, [3, -6, -0.5], [30, 6, 0.1], Label.ROAD)


def car_parts():
    return made.gaussians(150, 3, [-2.2, -0.9, -0.8], [2.2, 0.9, 0.8], Label.MOVABLE)


def rotated(part, world_from_box):
    """Gaussians of a box frame in the world; their colours are evaluated as seen from the camera."""
    turn = geometry.quat_from_matrix(world_from_box[:3, :3])
    quat = geometry.quat_normalize(geometry.quat_multiply(turn[None], part.quat_wxyz))
    eye = camera_pose(AT_US)[:3, 3]
    mean = geometry.transform_points(world_from_box, part.mean_m)
    toward = (mean - eye) @ world_from_box[:3, :3]
    x, y, z = (toward / np.linalg.norm(toward, axis=1, keepdims=True)).T
    functions = [
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * z * z - 1),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (5 * z * z - 1), 0.3731763325901154 * z * (5 * z * z - 3),
        -0.4570457994644658 * x * (5 * z * z - 1), 1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    rgb = np.maximum(part.rgb + np.einsum("kn,nkc->nc", np.stack(functions), part.sh_rest), 0)
    return dataclasses.replace(
        part, mean_m=mean.astype(np.float32), quat_wxyz=quat.astype(np.float32), rgb=rgb.astype(np.float32),
        sh_rest=np.zeros_like(part.sh_rest),
    )  # fmt: skip


def camera_pose(t_us):
    return made.ego().at(t_us) @ made.FRONT


def picture(scene, actors=None, at_us=AT_US):
    camera = made.rig().cameras["front"]
    request = SensorRequest("s", camera, at_us, at_us + 1, np.repeat(camera_pose(AT_US)[None], 2, axis=0), actors or {})
    return CpuRenderer(scene, threads=2).render_camera(request, ("rgb",)).rgb.astype(float)


def psnr(a, b):
    return 10 * np.log10(255**2 / max(np.mean((a - b) ** 2), 1e-12))


def truth(world_from_box=None):
    """The world that the files below were made from, at ``AT_US``: nothing moves, and nothing is read."""
    track = made.curved_track()
    pose = track.path.at(AT_US) if world_from_box is None else world_from_box
    static = Gaussians.concatenate([background(), road(), rotated(car_parts(), pose)])
    return GaussianScene("truth", static, DynamicGaussians.empty(), SKY, {}, made.rig(), made.ego(), [], None,
                         (made.START_US, made.START_US + 3_000_001))  # fmt: skip


def arrays(nre_from_world=None, **extra):
    """The arrays of the world of ``truth`` in the NRE frame, which may be moved from the world by whole metres."""
    shift = np.zeros(3, np.float32) if nre_from_world is None else nre_from_world[:3, 3].astype(np.float32)
    static = {"background": background(), "road": road()}
    static = {name: dataclasses.replace(part, mean_m=part.mean_m + shift) for name, part in static.items()}
    return made.nurec_arrays(static | {"dynamic_rigids": (car_parts(), np.ones(150))}, sky=SKY, extra=extra)


IDS = {"dynamic_rigids": ["other-1@scene:x", "car-7@scene:x"]}


def archive(path, members, **kwargs):
    sidecars = made.json_sidecars([made.curved_track()], **kwargs)
    return made.usdz(path, {"default.usda": made.ROOT_LAYER, **sidecars, **members})


ONE_ACTOR = {"dynamic_rigids": ["car-7"]}
"""The track of the rigid Gaussians of ``small_arrays``."""


def small_arrays():
    """Ten Gaussians in two layers and a grey sky, for tests of the file alone."""
    parts = {"background": made.gaussians(6, 1, [4, -8, 0], [30, 8, 5]),
             "dynamic_rigids": (made.gaussians(4, 2, [-1, -1, -1], [1, 1, 1], Label.MOVABLE), np.zeros(4))}  # fmt: skip
    return made.nurec_arrays(parts, sky=np.full((6, 2, 2, 3), 0.5))
