"""Layers of a street of which the network knows everything: what is drawn from them must be the street."""

import numpy as np
import pytest
import reconstruct_street
import render_scenes
import torch

from nurec_sim import geometry
from nurec_sim.network.profiles import PROFILES
from nurec_sim.network.tensors import ContextMaps, NetworkOutputs, QueryGaussians, SemanticClass
from nurec_sim.reconstruct.feedforward.inputs.frames import ChunkWindow
from nurec_sim.reconstruct.feedforward.inputs.window import chunk_inputs
from nurec_sim.reconstruct.feedforward.layers import chunk_layers
from nurec_sim.reconstruct.feedforward.method import _tracks
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.render.cpu.renderer import CpuRenderer
from nurec_sim.types import GaussianScene, SensorRequest

FRAMES = 7
CAR, WALKER = 5, 6
"""What ``Street.cast`` calls the two boxes."""
STEP_M = {CAR: (1.4, 0.0), WALKER: (0.0, -0.3)}
"""Their motion from one frame to the next; the network sees every second one."""


def street(labelled):
    k = np.arange(FRAMES)[:, None]
    boxes = {
        "car": ((4.0, 1.8, 1.5), [12.0, -1.5] + k * STEP_M[CAR]),
        "walker": ((0.6, 0.6, 1.7), [15.0, 4.0] + k * STEP_M[WALKER]),
    }
    camera = reconstruct_street.camera(width=384, height=192)
    return reconstruct_street.Street(FRAMES, cameras=(camera,), boxes=boxes, labelled=labelled)


def true_outputs(log, chunk):
    """What a perfect network would say of a chunk of a street."""
    scene_from_world = geometry.inverse(chunk.world_from_scene)
    position, semantic, motion, scale = [], [], [], []
    for number, image in enumerate(chunk.images):
        rays = chunk.tensors.rays[0, number].double().numpy().reshape(-1, 6)
        origin = geometry.transform_points(chunk.world_from_scene, rays[:, :3])
        direction = rays[:, 3:] @ chunk.world_from_scene[:3, :3].T
        distance, what = log.cast(origin[0], direction, image.frame)
        far = np.where(np.isfinite(distance), distance, 100.0)
        position.append(origin + far[:, None] * direction)
        semantic.append(np.select([what == 0, what == 1, what >= CAR], [SemanticClass.SKY, SemanticClass.ROAD,
                                                                        SemanticClass.MOVABLE]))  # fmt: skip
        to_next = np.zeros((len(far), 3))
        for kind, step in STEP_M.items():
            to_next[what == kind, :2] = 2 * np.array(step)
        motion.append(np.stack([-to_next, to_next], axis=1))
        scale.append(0.6 * far / image.camera.lens.fx_px)
    semantic = np.concatenate(semantic)
    v, height, width = chunk.ego.shape
    n = v * height * width

    def tensor(values):
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))[None]

    gaussians = QueryGaussians(
        position_m=tensor(geometry.transform_points(scene_from_world, np.concatenate(position))),
        quat_wxyz=tensor(np.tile([1.0, 0, 0, 0], (n, 1))),
        scale_m=tensor(np.repeat(np.concatenate(scale)[:, None], 3, axis=1)),
        opacity=tensor(np.where(semantic == SemanticClass.SKY, 0.0, 0.9)),
        rgb=chunk.tensors.rgb.reshape(1, n, 3),
        normal=torch.zeros(1, n, 3),
        semantic=torch.from_numpy(semantic)[None],
        source=torch.arange(n)[None],
        motion_m=tensor(np.concatenate(motion) @ scene_from_world[:3, :3].T),
    )
    logits = torch.nn.functional.one_hot(torch.from_numpy(semantic), 5).float().reshape(1, v, height, width, 5)
    ones = torch.ones(1, v, height, width)
    context = ContextMaps(ones, chunk.tensors.rgb, ones[..., None].expand(-1, -1, -1, -1, 3), logits, None)
    sky = torch.zeros(1, 6, 8, 8, 3)
    return NetworkOutputs(context, gaussians, sky, sky[..., :1], False, torch.eye(3, 4)[None, None])


@pytest.fixture(scope="module", params=["boxes", "no boxes", "a box of the car only"])
def world(request):
    log = street(request.param != "no boxes")
    if request.param == "a box of the car only":
        log.tracks = tuple(track for track in log.tracks if track.id == "car")
    settings = FeedForwardSettings(sky_px=64, image_pixels=336 * 196)
    window = ChunkWindow(0, (int(log.t_us[0]), int(log.t_us[-1])), {"front": tuple(range(0, FRAMES, 2))})
    chunk = chunk_inputs(log, PROFILES["tiny"], window, settings, {})
    with torch.inference_mode():
        outputs = true_outputs(log, chunk)
    layers = chunk_layers(log, chunk, outputs, settings)
    tracks, dynamic = _tracks(log, layers.dynamic)
    scene = GaussianScene("street", layers.static, dynamic, layers.sky, layers.isp, log.rig, log.ego, tracks, None,
                          log.span_us)  # fmt: skip
    return log, scene, CpuRenderer(scene, threads=1)


def picture(log, renderer, frame, actors=None):
    t_us = int(log.t_us[frame])
    pose = log.world_from_camera("front", frame)
    request = SensorRequest("street", log.rig.cameras["front"], t_us, t_us + 1, pose, actors or {})
    return renderer.render_camera(request).rgb


def shown(log, frame, what):
    """Which pixels of a frame of the log show a box."""
    from nurec_sim import sensors

    rays, _ = sensors.pixel_rays(log.rig.cameras["front"])
    pose = log.world_from_camera("front", frame)[0]
    return (log.cast(pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T, frame)[1] == what).reshape(rays.shape[:2])


def test_two_tracks_hold_all_moving_gaussians(world):
    _, scene, _ = world
    assert len(scene.tracks) == 2 and set(scene.dynamic.track.tolist()) == {0, 1}
    assert {track.label for track in scene.tracks} in ({"automobile"}, {"automobile", "person"})


def test_where_a_log_has_boxes_they_alone_are_actors(world):
    log, scene, _ = world
    labelled = {track.id for track in log.tracks}
    for track in scene.tracks:
        assert track.labelled == (track.id in labelled)
        assert track.actor == track.controllable == (track.labelled or not labelled)
    assert len([track for track in scene.tracks if track.actor]) == (len(labelled) or 2)


@pytest.mark.parametrize("frame", [3, 4])
def test_frames_that_the_network_saw_or_did_not_see_are_drawn(world, frame):
    log, _, renderer = world
    image, drawn = log.image("front", frame), picture(log, renderer, frame)
    assert render_scenes.psnr_db(drawn, image) > 23
    for what in (CAR, WALKER):
        mask = shown(log, frame, what)
        # Neither behind nor ahead of where it is: its own pixels have its colour.
        assert mask.sum() > 60 and np.abs(drawn[mask].mean(axis=0) - image[mask].mean(axis=0)).max() < 12


def test_a_requested_pose_takes_the_whole_car_along(world):
    log, scene, renderer = world
    number = int(np.argmax([track.size_m[0] for track in scene.tracks]))
    track, t_us = scene.tracks[number], int(log.t_us[3])
    below = track.path.at(t_us)
    below[2, 3] -= 100.0
    hidden = picture(log, renderer, 3, {track.id: np.stack([below, below])})
    mask = shown(log, 3, CAR)
    red = (hidden[..., 0].astype(int) - hidden[..., 2] > 100) & mask
    assert red.sum() < 0.02 * mask.sum()
    outside = np.ones(mask.shape, bool)
    rows, columns = np.nonzero(mask)
    outside[rows.min() - 3 : rows.max() + 4, columns.min() - 3 : columns.max() + 4] = False
    assert np.array_equal(hidden[outside], picture(log, renderer, 3)[outside])
