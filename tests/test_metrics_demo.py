"""The off-road grid on the demo clip: what a reconstruction believes to be road, against the street's own polygon."""

from pathlib import Path

import pytest

from nurec_sim import logs
from nurec_sim.metrics import offroad_agreement, scene_offroad_grid
from nurec_sim.reconstruct import reconstruct

CLIP = Path(__file__).parents[1] / "scenarios" / "demo_clip.zip"


@pytest.mark.slow
@pytest.mark.skipif(not CLIP.exists(), reason="the demo clip is not there")
def test_the_lifted_demo_clip_knows_its_road():
    clip = logs.open_clip(CLIP)
    scene = reconstruct(clip, "lift")
    grid = scene_offroad_grid(scene)
    found = offroad_agreement(grid, clip.road_map, scene.ego, scene.rig.body, placements=900, seed=0)
    print(found)
    assert found.agreement >= 0.95
    assert found.unknown_frac <= 0.05
    assert grid.overruled_frac < 0.05
