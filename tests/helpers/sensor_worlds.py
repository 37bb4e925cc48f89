"""A small town to look at, compiled once per test process, and requests along its drive."""

import dataclasses
import functools
from unittest import mock

import numpy as np
import pytest

from nurec_sim.types import LidarModel, SensorRequest
from nurec_sim.world import TrueWorld, pick_backend, town_plan
from nurec_sim.world.model.assemble import build_town
from nurec_sim.world.sense import simulator as sense

NEAR_THE_DRIVE_M = 60.0


@functools.cache
def small_plan():
    """A curve with traffic and walkers, and only the houses and things along the drive."""
    plan = town_plan(7, template="curve")
    drive = plan.ego_trajectory().position_m[:, :2]

    def near(things, most):
        places = np.array([(thing.x_m, thing.y_m) for thing in things]).reshape(-1, 2)
        apart = np.linalg.norm(places[:, None] - drive[None], axis=2).min(axis=1)
        return tuple(things[i] for i in np.argsort(apart)[:most] if apart[i] < NEAR_THE_DRIVE_M)

    return dataclasses.replace(plan, buildings=near(plan.buildings, 14), props=near(plan.props, 40))


_towns = {}


def true_world(plan, backend, **options):
    """A TrueWorld whose town is compiled once per plan; worlds of one town must not be used at the same time."""

    def built(wanted):
        if id(wanted) not in _towns:
            _towns[id(wanted)] = wanted, build_town(wanted)
        return _towns[id(wanted)][1]

    with mock.patch.object(sense, "build_town", built):
        return TrueWorld(plan, backend, **options)


def painted_world(plan, **options):
    """One that draws with OpenGL; skips the test where nothing can."""
    backend = pick_backend()
    if backend == "rays":
        pytest.skip("neither EGL nor OSMesa works here (or NUREC_SIM_GL=rays)")
    return true_world(plan, backend, **options)


def request_at(plan, sensor, seconds, duration_us=0, actors=None):
    """The sensor where the recorded drive has it."""
    start = plan.span_us[0] + round(seconds * 1e6)
    mount = sensor.rig_from_lidar if isinstance(sensor, LidarModel) else sensor.rig_from_camera
    poses = plan.ego_trajectory().at(np.array([start, start + duration_us])) @ mount
    return SensorRequest("town", sensor, start, start + duration_us, poses, actors or {})
