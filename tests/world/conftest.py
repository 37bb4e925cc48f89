"""A small town, seen by rays and by OpenGL."""

import pytest
from sensor_worlds import painted_world, small_plan, true_world


@pytest.fixture(scope="module")
def plan():
    return small_plan()


@pytest.fixture(scope="module")
def rays(plan):
    with true_world(plan, "rays") as world:
        yield world


@pytest.fixture(scope="module")
def painted(plan):
    with painted_world(plan) as world:
        yield world
