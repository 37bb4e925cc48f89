"""Scenes out to PLY and sky files and in again: they look the same, and what is not known is said."""

import dataclasses

import numpy as np
import pytest
import render_scenes as worlds
import scene_worlds
import tiny_clip
from ply_files import standard, textured_sky, values

from nurec_sim import cli, geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.render.cpu.renderer import CpuRenderer
from nurec_sim.render.layers import view_colour
from nurec_sim.scene import export_scene, import_scene, read_ply, read_scene, scene_hash, write_scene
from nurec_sim.scene.harmonics import rotate_harmonics
from nurec_sim.scene.interop.sky_sidecar import SkySidecar, write_sky
from nurec_sim.scene.transform import UP_AXES
from nurec_sim.scene.usd.layers import static_layer
from nurec_sim.types import Label


def street(sh=8):
    """Static and moving Gaussians in front of a camera, under a sky, with a colour correction."""
    static = worlds.cloud(2000, sh=sh)
    static.label[:500] = Label.ROAD
    isp = {"front": np.array([[0.9, 0.05, 0.0, 0.02], [0.0, 1.1, 0.0, -0.03], [0.02, 0.0, 0.95, 0.0]])}
    dynamic = dataclasses.replace(worlds.moving_cloud(200), track=np.full(200, 0, np.int32))
    scene = worlds.scene(static, dynamic, [worlds.track()], textured_sky(32), isp)
    camera = worlds.camera(320, 200)
    for part in (scene.static, scene.dynamic.gaussians):
        part.quat_wxyz[:] = geometry.quat_normalize(part.quat_wxyz)
    return dataclasses.replace(scene, rig=dataclasses.replace(scene.rig, cameras={"front": camera}))


def view(scene, t_us=worlds.START_US, yaw=0.0):
    pose = geometry.pose_from_xyyaw(0, 0, yaw)
    request = worlds.request(scene.rig.cameras["front"], pose, pose, t_us, t_us + 1)
    return CpuRenderer(scene, threads=1).render_camera(request).rgb


@pytest.mark.parametrize(
    "sh, layout, up", [(0, "inria", "z"), (0, "release", "-y"), (8, "inria", "y"), (8, "release", "z")]
)
def test_a_scene_looks_the_same_after_the_round_trip(tmp_path, sh, layout, up):
    scene = dataclasses.replace(street(sh), dynamic=worlds.scene().dynamic)
    exported = export_scene(scene, tmp_path / "a.ply", layout=layout, up=up)
    assert [path.name for path in exported.paths] == ["a.ply", "a.sky.npz", "a.sky.png"]
    back = import_scene(tmp_path / "a.ply", like=scene)  # the file says what is up
    assert back.provenance["up"] == up
    for yaw in (0.0, 2.0):
        assert worlds.psnr_db(view(back, yaw=yaw), view(scene, yaw=yaw)) > 50
    assert view(scene).std() > 20
    assert np.array_equal(back.sky, scene.sky.astype(np.float16)) and np.isfinite(back.sky).all()
    road = scene.static.label == Label.ROAD
    assert np.array_equal(back.static.label == Label.ROAD, road if layout == "release" else road & False)
    assert any("no road:" in text for text in unknown_of(back)) == (layout == "inria")


@pytest.mark.parametrize("up", list(UP_AXES))
def test_an_export_has_the_axis_asked_for_up(tmp_path, up):
    """A Gaussian high above the origin, its normal upwards, lies on that axis; ahead (x) is as an import takes it."""
    above = dataclasses.replace(
        worlds.gaussians([[0, 0, 5.0], [7.0, 0, 0]]), normal=np.array([[0, 0, 1], [1, 0, 0]], np.float32)
    )
    export_scene(worlds.scene(above), tmp_path / "a.ply", up=up)
    plain, _ = read_ply(tmp_path / "a.ply")
    file_up = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    assert np.allclose(plain.mean_m[0], 5 * file_up) and np.allclose(plain.normal[0], file_up)
    assert f" {up} up\n".encode() in (tmp_path / "a.ply").read_bytes()[:200]
    ahead = {"z": (0, 1), "-z": (0, 1), "y": (2, -1), "-y": (2, 1), "x": (2, -1), "-x": (2, 1)}[up]  # docs/exchange.md
    assert plain.mean_m[1, ahead[0]] == pytest.approx(7 * ahead[1])


@pytest.mark.parametrize("after_us", [-30_000, 0, 70_001])
def test_moving_gaussians_are_written_as_they_are_at_an_instant(tmp_path, after_us):
    scene = dataclasses.replace(street(sh=0), span_us=(900_000, 2_000_000))
    t_us = worlds.START_US + after_us
    exported = export_scene(scene, tmp_path / "a.ply", at_us=t_us)
    back = import_scene(tmp_path / "a.ply", like=dataclasses.replace(scene, span_us=(1_000_000, 2_000_000)))
    back = dataclasses.replace(back, span_us=scene.span_us)
    assert 2000 < exported.written < 2200 and exported.moving_left_out == 0
    assert worlds.psnr_db(view(back, t_us), view(scene, t_us)) > 50
    bare = dataclasses.replace(scene, dynamic=worlds.scene().dynamic)
    assert worlds.psnr_db(view(bare, t_us), view(scene, t_us)) < 40


def test_without_an_instant_moving_gaussians_stay_out(tmp_path):
    scene = street()
    exported = export_scene(scene, tmp_path / "a.ply")
    assert (exported.written, exported.moving_left_out) == (2000, 200)
    with pytest.raises(ArchiveError, match=r"instant 5 us is outside of the scene, which spans \[1000000, 2000000\)"):
        export_scene(scene, tmp_path / "b.ply", at_us=5)
    assert not (tmp_path / "b.sky.npz").exists()


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        export_scene(street(), tmp_path / name / "x.ply")
    for suffix in ("ply", "sky.npz", "sky.png"):
        assert (tmp_path / f"a/x.{suffix}").read_bytes() == (tmp_path / f"b/x.{suffix}").read_bytes()


def test_an_export_replaces_nothing_unasked(tmp_path):
    (tmp_path / "a.sky.npz").write_bytes(b"mine")
    with pytest.raises(ArchiveError, match=r"a\.sky\.npz exists"):
        export_scene(street(), tmp_path / "a.ply")
    assert (tmp_path / "a.sky.npz").read_bytes() == b"mine" and not (tmp_path / "a.ply").exists()
    export_scene(street(), tmp_path / "a.ply", overwrite=True)
    with pytest.raises(ArchiveError, match=r"must end in \.ply"):
        export_scene(street(), tmp_path / "a.usdz")
    for wrong in ({"layout": "spark"}, {"up": "w"}):
        with pytest.raises(ArchiveError, match="must be one of"):
            export_scene(street(), tmp_path / "b.ply", **wrong)
    assert not list(tmp_path.glob("b*"))


def test_a_foreign_file_becomes_a_scene_that_can_be_written(tmp_path):
    scene = import_scene(standard(tmp_path / "garden.ply", values(50, k=15)))
    assert scene.id == "garden" and scene.span_us == (1_000_000, 2_000_000) and list(scene.rig.cameras) == ["camera"]
    unknown = " ".join(scene.provenance["unknown"])
    for word in ("moving", "LiDAR intensity", "road", "sensors", "sky"):
        assert f"no {word}" in unknown
    write_scene(scene, tmp_path / "garden.usdz")
    camera = scene.rig.cameras["camera"]
    pose = scene.ego.at(1_000_000) @ camera.rig_from_camera
    assert np.allclose(pose[:3, 2], [1, 0, 0]) and np.allclose(pose[:3, 3], [0, 0, 1.5])


@pytest.mark.parametrize("up", list(UP_AXES))
def test_the_axis_that_points_up_becomes_z(tmp_path, up):
    file_up = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    table = values(4, k=15)
    for axis, name in enumerate("xyz"):
        table[name][0] = 5 * file_up[axis]
    path = standard(tmp_path / "a.ply", table)
    write_sky(SkySidecar(textured_sky(8)), tmp_path / "a.sky.npz")  # its colours tell directions in the file
    plain, turned = read_ply(path)[0], import_scene(path, up=up)
    rotation = np.array(UP_AXES[up], float)
    assert geometry.is_rotation(rotation) and np.allclose(turned.static.mean_m[0], [0, 0, 5])
    before, after = (geometry.matrix_from_quat(g.quat_wxyz) for g in (plain, turned.static))
    assert np.allclose(after, rotation @ before, atol=1e-5)
    eye = np.array([1.0, -2.0, 0.5])
    seen = view_colour(plain.rgb, plain.sh_rest, plain.mean_m - eye)
    seen_turned = view_colour(turned.static.rgb, turned.static.sh_rest, turned.static.mean_m - rotation @ eye)
    assert np.allclose(seen, seen_turned, atol=1e-4)
    assert np.allclose(turned.sky, geometry.cubemap_directions(8) @ rotation * 0.4 + 0.5, atol=1e-3)


def test_harmonics_turn_by_any_angle():
    rng = np.random.default_rng(4)
    rotation = geometry.matrix_from_quat(rng.normal(size=4))
    direction = rng.normal(size=(20, 3))
    for k in (3, 8, 15):
        rest = np.repeat(rng.normal(size=(1, k, 3)).astype(np.float32), 20, axis=0)
        rgb = np.full((20, 3), 5.0)
        before = view_colour(rgb, rest, direction)
        assert np.allclose(
            before, view_colour(rgb, rotate_harmonics(rest, rotation), direction @ rotation.T), atol=1e-5
        )
        assert before.std() > 0.1


def test_an_axis_that_is_none(tmp_path):
    with pytest.raises(ArchiveError, match=r"up must be one of \['z', '-z', 'y', '-y', 'x', '-x'\], got 'w'"):
        import_scene(tmp_path / "a.ply", up="w")


def test_surroundings_come_from_a_scene_and_skies_from_the_nearest_file(tmp_path):
    like = scene_worlds.full_scene()
    path = standard(tmp_path / "a.ply", values(5))
    scene = import_scene(path, like=like)
    assert scene.rig is like.rig and scene.span_us == like.span_us and scene.tracks is like.tracks
    assert scene.sky is like.sky and scene.isp is like.isp and scene.camera_times_us is like.camera_times_us
    write_sky(SkySidecar(textured_sky(4)), tmp_path / "a.sky.npz")
    write_sky(SkySidecar(textured_sky(2)), tmp_path / "other.npz")
    assert import_scene(path, like=like).sky.shape == (6, 4, 4, 3)
    assert import_scene(path, like=like, sky=tmp_path / "other.npz").sky.shape == (6, 2, 2, 3)


@pytest.mark.slow
def test_a_layer_takes_sky_and_colours_from_a_scene(tmp_path):
    """Of OpenUSD files too: what SCENE has and the file has not."""
    scene = dataclasses.replace(street(sh=0), dynamic=worlds.scene().dynamic)
    (tmp_path / "splats.usdc").write_bytes(static_layer(scene.static))
    back = import_scene(tmp_path / "splats.usdc", like=scene)
    for yaw in (0.0, 2.0):
        assert worlds.psnr_db(view(back, yaw=yaw), view(scene, yaw=yaw)) > 50
    assert back.sky is scene.sky and back.tracks is scene.tracks and not any("sky" in t for t in unknown_of(back))
    assert back.provenance["like"] == "test"
    write_sky(SkySidecar(textured_sky(4)), tmp_path / "mine.npz")
    mine = import_scene(tmp_path / "splats.usdc", like=scene, sky=tmp_path / "mine.npz")
    assert mine.sky.shape == (6, 4, 4, 3) and mine.provenance["sky_file"] == "mine.npz" and not mine.isp
    assert not any(
        "sky" in text for text in unknown_of(import_scene(tmp_path / "splats.usdc", sky=tmp_path / "mine.npz"))
    )


def unknown_of(scene):
    return scene.provenance["unknown"]


def test_a_sky_file_without_corrections_leaves_those_of_the_scene(tmp_path):
    scene = street(sh=0)
    export_scene(scene, tmp_path / "a.ply")
    assert import_scene(
        tmp_path / "a.ply", like=dataclasses.replace(scene, isp={"other": np.eye(3, 4)})
    ).isp.keys() == {"front"}
    np.savez(tmp_path / "a.sky.npz", format_version=1, sky_cubemap=np.zeros((6, 2, 2, 3), np.float16))
    back = import_scene(tmp_path / "a.ply", like=scene)
    assert back.isp is scene.isp and back.sky.shape == (6, 2, 2, 3)


def test_an_archive_of_ours_stays_what_it_is(tmp_path):
    scene = street()
    write_scene(scene, tmp_path / "a.usdz")
    back = import_scene(tmp_path / "a.usdz")
    assert scene_hash(back) == scene_hash(read_scene(tmp_path / "a.usdz"))
    like = scene_worlds.full_scene()
    back = import_scene(tmp_path / "a.usdz", like=like)
    assert back.road_map is like.road_map and list(back.rig.cameras) == ["front"]
    assert np.allclose(back.sky, scene.sky, rtol=1e-3) and len(back.dynamic) == 200
    with pytest.raises(ArchiveError, match="has z up; got 'y'"):
        import_scene(tmp_path / "a.usdz", up="y")


# ---------------------------------------------------------------------------------------------------- command line


def test_export_and_import_on_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_scene(street(sh=0), "street.usdz")
    cli.main(["export", "street.usdz", "--out", "out/a.ply", "--at-us", "1000000"])
    text = capsys.readouterr().out
    assert "Gaussians" in text and "wrote out/a.sky.npz" in text
    cli.main(["import", "out/a.ply", "--like", "street.usdz"])
    text = capsys.readouterr().out
    assert "not known: no LiDAR intensity" in text and "wrote a.usdz" in text
    scene = read_scene("a.usdz")
    assert list(scene.rig.cameras) == ["front"] and scene.provenance["like"] == "test"
    clip = tiny_clip.write(tmp_path / "clip")
    cli.main(["import", "out/a.ply", "--like", str(clip), "--out", "b.usdz", "--up", "-y"])
    assert len(read_scene("b.usdz").ego.t_us) > 1 and read_scene("b.usdz").provenance["up"] == "-y"
    for arguments in (["export", "street.usdz", "--out", "out/a.ply"], ["import", "out/a.ply"]):
        with pytest.raises(SystemExit) as stop:
            cli.main(arguments)
        assert stop.value.code == 1 and "exists" in capsys.readouterr().err
