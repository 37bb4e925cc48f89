"""Towns with dense traffic, and with the turn that was asked for."""

import numpy as np
import pytest
from repetition import slow_after

from nurec_sim import geometry
from nurec_sim.world import town_plan
from nurec_sim.world.plan.swept_boxes import Boxes, touching
from nurec_sim.world.plan.town import EGO_MIDDLE_M

SEED, TEMPLATE, SECONDS = 105, "t_junction", 6.0


@pytest.fixture(scope="module")
def usual():
    return town_plan(SEED, "test", TEMPLATE, SECONDS)


@pytest.fixture(scope="module")
def dense():
    return town_plan(SEED, "test", TEMPLATE, SECONDS, "dense", "right")


def turned_deg(plan):
    """How far the ego turns to the left."""
    return np.degrees(np.ptp(yaw := np.unwrap([pose[3] for pose in plan.ego])) * np.sign(yaw[-1] - yaw[0]))


def moving_close_ahead(plan):
    """Mean number of actors that move within 40 m and 50 degrees of straight ahead."""
    t_us = np.arange(plan.span_us[0], plan.span_us[1], 500_000)
    ego, counts = geometry.inverse(plan.ego_trajectory().at(t_us)), []
    for track in plan.tracks():
        world = track.path.at(t_us)[:, :3, 3]
        here = np.einsum("nij,nj->ni", ego[:, :3, :3], world) + ego[:, :3, 3]
        moves = np.linalg.norm(track.path.at(t_us + 250_000)[:, :3, 3] - world, axis=1) > 0.1
        counts.append(moves & (np.hypot(*here[:, :2].T) < 40) & (np.abs(here[:, 1]) < 1.2 * here[:, 0]))
    return np.sum(counts, axis=0).mean()


def test_a_dense_town_is_the_same_town_with_more_in_it(usual, dense):
    for part in ("roads", "junctions", "crossings", "buildings", "props", "weather", "style", "terrain"):
        assert getattr(dense, part) == getattr(usual, part), part
    vehicles, walkers = (
        [sum((actor.kind == "pedestrian") == people and not actor.id.startswith("parked") for actor in plan.actors)
         for plan in (usual, dense)]
        for people in (False, True)
    )  # fmt: skip
    assert vehicles[0] <= 18 < vehicles[1] <= 30 and walkers[0] <= 8 + 2 * len(usual.crossings)
    assert walkers[1] > 1.5 * walkers[0]
    assert any(actor.id == "lead" for actor in dense.actors)
    assert moving_close_ahead(dense) > max(4.0, 1.2 * moving_close_ahead(usual))


def test_nobody_touches_anybody_in_dense_traffic(dense):
    t_us = np.arange(dense.span_us[0], dense.span_us[1] + 1, 100_000)
    ego = np.array(dense.ego)
    x, y, yaw = (np.interp(t_us, ego[:, 0], ego[:, k]) for k in (1, 2, 3))
    ways = [np.stack([x + EGO_MIDDLE_M * np.cos(yaw), y + EGO_MIDDLE_M * np.sin(yaw), yaw])]
    for actor in dense.actors:
        path = np.array(actor.path)
        ways.append(np.stack([np.interp(t_us, path[:, 0], path[:, k]) for k in (1, 2, 4)]))
    table = np.array(ways).transpose(2, 0, 1)
    half = np.array([(4.9, 1.9), *(actor.size_m[:2] for actor in dense.actors)]) / 2
    names = ["ego", *(actor.id for actor in dense.actors)]
    assert [(names[i], names[j]) for i, j in touching(Boxes(table[..., :2], table[..., 2], half))] == []


@pytest.mark.slow
def test_the_same_wishes_give_the_same_plan(dense):
    assert town_plan(SEED, "test", TEMPLATE, SECONDS, "dense", "right") == dense


@pytest.mark.parametrize("turn", slow_after(1, ["right", "left", "straight"]))
def test_the_ego_turns_as_it_was_asked_to(turn, dense):
    plan = dense if turn == "right" else town_plan(SEED, "test", "x_junction", 12.0, turn=turn)
    low, high = {"right": (-115, -65), "left": (65, 115), "straight": (-40, 40)}[turn]
    assert low < turned_deg(plan) < high


def test_impossible_wishes_are_refused():
    with pytest.raises(
        ValueError, match=r"no drive of 3 s in town 4 of split 'test' \(straight\) goes left at its first"
    ):
        town_plan(4, "test", "straight", 3.0, turn="left")
    with pytest.raises(ValueError, match="no traffic density 'heavy'; have usual, dense"):
        town_plan(4, traffic_density="heavy")
    with pytest.raises(ValueError, match="no turn 'around'; have left, right, straight"):
        town_plan(4, turn="around")
