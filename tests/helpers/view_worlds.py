"""What the tests of the viewer look at: two reconstructions of one street, its log with plain images, two rollouts."""

import dataclasses

import metrics_worlds
import numpy as np
import serving_world

from nurec_sim import geometry
from nurec_sim.logs import Clip, ImageRecord, SweepRecord
from nurec_sim.render import make_renderer
from nurec_sim.serving.store import LoadedScene
from nurec_sim.types import Event, GaussianScene, Rollout, SweepPoints
from nurec_sim.view.sources import Opened, World, local_world

START_US = serving_world.START_US
FRAME_US, EXPOSURE_US = 200_000, 20_000
POINT = np.array([6.0, 1.0, -0.5])
"""The only LiDAR point of the log, in the frame of the LiDAR."""


def scene(seed: int = 0) -> GaussianScene:
    frames = START_US + FRAME_US * np.arange(10)
    return dataclasses.replace(
        serving_world.scene(seed=seed),
        camera_times_us={"front": np.stack([frames, frames + EXPOSURE_US], axis=1)},
        provenance={"method": "lift" if seed == 0 else "dense"},
    )


def world(seed: int = 0) -> World:
    made = scene(seed)
    return local_world(LoadedScene(made, make_renderer(made, "cpu", threads=1)))


class _Source:
    def image(self, camera_id, index):
        return np.full((180, 320, 3), 20 * index, np.uint8)

    def sweep(self, lidar_id, index):
        return SweepPoints(POINT[None])

    def ego_mask(self, camera_id):
        return None


def clip() -> Clip:
    made = scene()
    mounting, roof = made.rig.cameras["front"].rig_from_camera, made.rig.lidars["roof"].rig_from_lidar
    times = made.camera_times_us["front"]
    images = [ImageRecord(f"{i}.png", int(a), int(b), made.ego.at(np.array([a, b])) @ mounting)
              for i, (a, b) in enumerate(times)]  # fmt: skip
    sweeps = [SweepRecord(f"{i}.bin", int(a), int(a), int(a), made.ego.at(int(a)) @ roof, True)
              for i, (a, _) in enumerate(times)]  # fmt: skip
    return Clip("street", made.rig, made.ego, {"front": images}, {"roof": sweeps}, _Source(), tracks=made.tracks)


def rollout() -> Rollout:
    """Ten states along y = 1, hitting car-1, which stands across the path until it vanishes after six states."""
    poses = np.stack([geometry.pose_from_xyyaw(2.0 * i, 1.0, 0.0) for i in range(10)])
    car = np.stack([geometry.pose_from_xyyaw(12.0, 1.0, np.pi / 2, 0.8)] * 10)
    car[7:] = np.nan
    made = metrics_worlds.rollout(poses, {"car-1": car})
    later = START_US - metrics_worlds.T0_US
    return dataclasses.replace(
        made,
        states=tuple(dataclasses.replace(state, t_us=state.t_us + later) for state in made.states),
        plans=tuple((t_us + later, dataclasses.replace(plan, t_us=plan.t_us + later)) for t_us, plan in made.plans),
        events=(Event(START_US + 100_000, "stop_session", "asked to"),),
    )


def opened(worlds: tuple[World, ...]) -> Opened:
    return Opened(worlds, clip(), {"hits": rollout()})
