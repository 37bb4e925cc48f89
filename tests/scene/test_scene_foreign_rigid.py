"""Rigid parts of tracks, as foreign archives hold them: renderers, archives and PLY exports place them alike."""

import dataclasses

import numpy as np
import pytest
from gpu_on_cpu.places import PLACES, launcher_at
from moving_layers import TRACKS, assert_packed_is_readable, layer
from render_scenes import START_US, camera, cloud, moved, moving_cloud, psnr_db, request, scene

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.render.cpu.renderer import CpuRenderer
from nurec_sim.render.layers import moving_gaussians
from nurec_sim.scene import check_scene, export_scene, read_ply, read_scene, write_scene
from nurec_sim.types import DynamicGaussians, Gaussians

LATE_US = START_US + 10_000_000


def mixed(sh=3):
    """Gaussians of two tracks, some recorded in the world and some rigid, and of none."""
    world = layer(100, sh)
    parts = [layer(60, sh, seed=8 + k).gaussians for k in (0, 1)]
    rigid = DynamicGaussians.rigid(Gaussians.concatenate(parts), np.repeat([0, 1], 180), START_US)
    order = np.random.default_rng(1).permutation(len(world) + len(rigid))
    both = [(world.knot_t_us, rigid.knot_t_us), (world.knot_m, rigid.knot_m), (world.track, rigid.track)]
    in_box = np.concatenate([np.zeros(len(world), bool), rigid.in_box])
    return DynamicGaussians(Gaussians.concatenate([world.gaussians, rigid.gaussians])[order],
                            *(np.concatenate(pair)[order] for pair in both), in_box[order])  # fmt: skip


@pytest.mark.parametrize("t_us", [START_US, START_US + 50_000, LATE_US])
@pytest.mark.parametrize("asked", [(), ("near",), ("near", "far")])
def test_the_packed_layer_is_the_readable_one(t_us, asked):
    count = assert_packed_is_readable(mixed(), t_us, {name: moved(0.4, 5, -3) for name in asked})
    assert (count > 100 * len(asked)) if asked else (count > 0) == (t_us != LATE_US)


def test_rigid_parts_stand_where_their_box_is():
    dynamic = DynamicGaussians.rigid(cloud(50), np.zeros(50), START_US)
    at_us = TRACKS[0].path.start_us + 30_000
    recorded = moving_gaussians(dynamic, TRACKS, at_us, {}, np.zeros(3))
    shown = dynamic.gaussians.mean_m[recorded_rows(dynamic, at_us)]
    assert np.allclose(recorded.mean_m, geometry.transform_points(TRACKS[0].path.at(at_us), shown), atol=1e-5)
    assert np.allclose(recorded.opacity, dynamic.gaussians.opacity[recorded_rows(dynamic, at_us)])
    asked = moving_gaussians(dynamic, TRACKS, LATE_US, {"near": moved(0.3, 1, 2)}, np.zeros(3))
    assert np.allclose(asked.mean_m, geometry.transform_points(moved(0.3, 1, 2), shown), atol=1e-5)
    assert len(moving_gaussians(dynamic, TRACKS, LATE_US, {}, np.zeros(3))) == 0


def recorded_rows(dynamic, t_us):
    from nurec_sim.render.layers import MIN_ALPHA, drawable

    return np.flatnonzero(drawable(dynamic.gaussians) & (dynamic.gaussians.opacity >= MIN_ALPHA))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("asked", [(), ("near",)])
def test_the_gpu_draws_the_same(place, asked):
    from nurec_sim.render.gpu.renderer import GpuRenderer

    launcher = launcher_at(place)
    part = dataclasses.replace(cloud(60, 5, sh=3))
    dynamic = DynamicGaussians.rigid(part, np.zeros(60), START_US)
    world = dataclasses.replace(scene(cloud(40), moving_cloud(40), TRACKS[:1]), dynamic=dynamic)
    wanted = request(camera())
    wanted = dataclasses.replace(wanted, actors={name: np.stack([moved(0.2, 2, 1)] * 2) for name in asked})
    ours = CpuRenderer(world, threads=2).render_camera(wanted, ("rgb",)).rgb
    theirs = GpuRenderer(world, launcher).render_camera(wanted, ("rgb",)).rgb
    assert psnr_db(ours, theirs) > 50


def unit(gaussians):
    return dataclasses.replace(gaussians, quat_wxyz=geometry.quat_normalize(gaussians.quat_wxyz).astype(np.float32))


def parked(count=50):
    """Rigid parts of the first track, beside Gaussians that stand still."""
    return scene(unit(cloud(40)), DynamicGaussians.rigid(unit(cloud(count, 7)), np.zeros(count), START_US), TRACKS[:1])


def test_archives_keep_them(tmp_path):
    dynamic = mixed(3)
    dynamic = dataclasses.replace(dynamic, gaussians=unit(dynamic.gaussians))
    world = dataclasses.replace(scene(unit(cloud(40)), dynamic, TRACKS))
    again = read_scene(write_scene(world, tmp_path / "a.usdz"))
    for name in ("knot_t_us", "knot_m", "track", "in_box"):
        assert np.array_equal(getattr(again.dynamic, name), getattr(dynamic, name))
    assert np.allclose(again.dynamic.gaussians.sh_rest, dynamic.gaussians.sh_rest, rtol=1e-3, atol=1e-7)


def test_exports_place_them(tmp_path):
    world, at_us = parked(), START_US + 30_000
    export_scene(world, tmp_path / "a.ply", at_us=at_us)
    written, _ = read_ply(tmp_path / "a.ply")
    wanted = geometry.transform_points(TRACKS[0].path.at(at_us), world.dynamic.gaussians.mean_m)
    assert np.allclose(written.mean_m[40:], wanted, atol=1e-4)


def test_usd_viewers_see_them_move(tmp_path):
    from pxr import Usd, UsdGeom

    world = parked()
    write_scene(world, tmp_path / "a.usdz")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    field = next(p for p in stage.Traverse() if p.GetPath().name.startswith("window"))
    at_us = TRACKS[0].path.start_us + 30_000
    code = Usd.TimeCode((at_us - world.span_us[0]) / 1000)
    matrix = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(field)).T
    assert np.allclose(matrix, TRACKS[0].path.at(at_us), atol=1e-6)
    assert UsdGeom.Imageable(field).ComputeVisibility(code) == "inherited"
    late = Usd.TimeCode((TRACKS[0].path.end_us + 2000 - world.span_us[0]) / 1000)
    assert UsdGeom.Imageable(field).ComputeVisibility(late) == "invisible"


def test_a_box_of_no_track_is_refused():
    dynamic = DynamicGaussians.rigid(unit(cloud(5)), np.full(5, -1), START_US)
    with pytest.raises(ArchiveError, match="dynamic.in_box: 5 of 5 are in the box of no track"):
        check_scene(dataclasses.replace(parked(), dynamic=dynamic))
