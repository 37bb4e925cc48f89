"""Particle fields of other programs open as scenes: any attribute type, transforms, units, axes, references."""

import dataclasses

import foreign_files as made
import numpy as np
import pytest
from nurec_archives import background, psnr, road

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.render.cpu.renderer import CpuRenderer
from nurec_sim.scene import read_scene
from nurec_sim.types import Gaussians, Label, SensorRequest


def picture(scene, static=None):
    """What the default camera sees; with other Gaussians in the same scene if given."""
    scene = scene if static is None else dataclasses.replace(scene, static=static)
    camera = scene.rig.cameras["camera"]
    pose = np.repeat(camera.rig_from_camera[None], 2, axis=0)
    lens = dataclasses.replace(camera.lens, fx_px=160, fy_px=160, cx_px=160, cy_px=90)
    small = dataclasses.replace(camera, width_px=320, height_px=180, lens=lens)
    request = SensorRequest("s", small, 1_000_000, 1_000_001, pose)
    return CpuRenderer(scene, threads=2).render_camera(request, ("rgb",)).rgb.astype(float)


def opened(path, data):
    path.write_bytes(data)
    return read_scene(path)


def moved(part, matrix, stretch):
    """Gaussians under a rotation, translation and uniform stretch, without view-dependent colours."""
    quat = geometry.quat_multiply(geometry.quat_from_matrix(matrix[:3, :3])[None], part.quat_wxyz)
    mean = geometry.transform_points(matrix, part.mean_m * stretch)
    return dataclasses.replace(part, mean_m=mean.astype(np.float32), quat_wxyz=quat.astype(np.float32),
                               scale_m=part.scale_m * np.float32(stretch))  # fmt: skip


def plain(part):
    return dataclasses.replace(part, sh_rest=None, rgb=np.maximum(part.rgb, 0))


@pytest.mark.parametrize("half", [False, True])
def test_float_and_half_attributes_of_several_fields(tmp_path, half):
    body = made.particle_field(background(), "a", half) + made.particle_field(road(), "Road", half)
    scene = opened(tmp_path / "garden.usda", made.stage(body))
    assert psnr(picture(scene), picture(scene, Gaussians.concatenate([background(), road()]))) > 50
    assert scene.id == "garden" and np.bincount(scene.static.label).tolist() == [300, 200]


def test_float_attributes_win_over_half_ones(tmp_path):
    wrong = "point3h[] positionsh = [" + ", ".join(["(0, 0, 0)"] * 300) + "]"
    scene = opened(tmp_path / "a.usda", made.stage(made.particle_field(background(), extra=wrong)))
    assert np.allclose(scene.static.mean_m, background().mean_m)


def test_transforms_units_and_axes(tmp_path):
    """Centimetres, y up, a turned and scaled parent: what was at (x, y, z) of the field ends at known places."""
    part = plain(background())
    inner = 'double3 xformOp:translate = (100, -50, 30)\n uniform token[] xformOpOrder = ["xformOp:translate"]'
    outer = ('float xformOp:rotateZ = 90\n float3 xformOp:scale = (2, 2, 2)\n'
             ' uniform token[] xformOpOrder = ["xformOp:rotateZ", "xformOp:scale"]')  # fmt: skip
    text = made.stage(made.particle_field(part, ops=inner), up="Y", meters=0.01, ops=outer)
    scene = opened(tmp_path / "a.usda", text)
    # In the field's parent: 2 * R(90 about z) * (p + t); in the world: y up becomes z up, -z becomes ahead; in metres.
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    world_from_stage = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    matrix = geometry.pose(world_from_stage @ turn, world_from_stage @ turn @ np.array([100, -50, 30]) * 0.02)
    wanted = moved(part, matrix, 0.02)
    assert np.allclose(scene.static.mean_m, wanted.mean_m, atol=1e-5)
    assert np.allclose(scene.static.scale_m, wanted.scale_m, rtol=1e-5)
    same = np.abs(np.sum(scene.static.quat_wxyz * wanted.quat_wxyz, axis=1))
    assert np.allclose(same, 1, atol=1e-5)


def test_uneven_scale_keeps_the_shape_of_every_gaussian(tmp_path):
    part = plain(background())
    ops = 'float3 xformOp:scale = (2, -0.5, 1)\n uniform token[] xformOpOrder = ["xformOp:scale"]'
    scene = opened(tmp_path / "a.usda", made.stage(made.particle_field(part, ops=ops)))

    def covariance(gaussians):
        axes = geometry.matrix_from_quat(gaussians.quat_wxyz) * gaussians.scale_m[:, None].astype(float)
        return axes @ np.swapaxes(axes, 1, 2)

    linear = np.diag([2, -0.5, 1])
    assert np.allclose(covariance(scene.static), linear @ covariance(part) @ linear, atol=1e-5)


def test_turned_fields_take_their_colours_along(tmp_path):
    """A field turned by 180 degrees about z: seen from the other side it looks as it did."""
    part = background()
    ops = 'float xformOp:rotateZ = 180\n uniform token[] xformOpOrder = ["xformOp:rotateZ"]'
    scene = opened(tmp_path / "a.usda", made.stage(made.particle_field(part, ops=ops)))
    original = opened(tmp_path / "b.usda", made.stage(made.particle_field(part)))
    camera = scene.rig.cameras["camera"]
    half_turn = geometry.pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ camera.rig_from_camera
    request = SensorRequest("s", camera, 1_000_000, 1_000_001, np.stack([half_turn, half_turn]))
    seen = CpuRenderer(scene, threads=2).render_camera(request, ("rgb",)).rgb.astype(float)
    first = dataclasses.replace(request, world_from_sensor=np.stack([camera.rig_from_camera] * 2))
    assert psnr(seen, CpuRenderer(original, threads=2).render_camera(first, ("rgb",)).rgb.astype(float)) > 50


def test_packages_with_references_and_sidecars(tmp_path):
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(made.stage(made.particle_field(background())).decode())
    layer.Export(str(tmp_path / "splats.usdc"))
    root = made.stage('    def Xform "A" (\n references = @./parts/splats.usdc@\n )\n {\n }')
    members = {"root.usda": root, "parts/splats.usdc": (tmp_path / "splats.usdc").read_bytes(), "notes.txt": b"x",
               **made.json_sidecars()}  # fmt: skip
    scene = read_scene(made.usdz(tmp_path / "a.usdz", members))
    assert np.array_equal(scene.static.mean_m, background().mean_m)
    assert list(scene.rig.cameras) == ["front"] and scene.id == "clip-1"
    assert "members that are not read: notes.txt" in scene.provenance["unknown"]


def test_nothing_outside_is_opened(tmp_path):
    (tmp_path / "secret.usda").write_bytes(made.stage(made.particle_field(background())))
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "near.usda").write_bytes(made.stage(made.particle_field(road())))
    (folder / "link.usda").symlink_to(tmp_path / "secret.usda")
    names = ["../secret.usda", str(tmp_path / "secret.usda"), "link.usda", "https://host/a.usda", "near.usda"]
    body = "\n".join(f'def Xform "A{k}" (\n references = @{name}@\n )\n {{\n }}' for k, name in enumerate(names))
    scene = opened(folder / "a.usda", made.stage(body))
    assert len(scene.static) == 200
    unknown = "\n".join(scene.provenance["unknown"])
    assert all(f"refers to '{name}', which is not beside it" in unknown for name in names[:-1])


@pytest.mark.parametrize(
    ("body", "head"),
    [
        ("", "    subLayers = [@../secret.usda@]\n"),
        ('def Xform "A" (\n payload = @../secret.usda@\n )\n {\n }', ""),
        ('def Xform "A" (\n variants = {\n string v = "a"\n }\n prepend variantSets = "v"\n )\n {\n'
         ' variantSet "v" = {\n "a" (\n prepend references = @../secret.usda@\n ) {\n }\n }\n }', ""),
        ('def Xform "A" (\n references = @`"../secret.usda"`@\n )\n {\n }', ""),
        ('def Xform "A" (\n clips = {\n dictionary default = {\n asset[] assetPaths = [@../secret.usda@]\n'
         ' asset manifestAssetPath = @../secret.usda@\n string primPath = "/World"\n }\n }\n )\n {\n }', ""),
    ],
)  # fmt: skip
def test_no_way_of_referring_leads_outside(tmp_path, body, head):
    (tmp_path / "secret.usda").write_bytes(made.stage(made.particle_field(background())))
    (tmp_path / "scene").mkdir()
    with pytest.raises(
        ArchiveError, match="not beside it or no USD layer; not read|value clips of /World/A are not read"
    ):
        opened(tmp_path / "scene" / "a.usda", made.stage(body, head=head))


def test_hidden_moving_and_other_things_are_named(tmp_path):
    sampled = "point3f[] positions.timeSamples = { 1: [(5, 0, 1)], 2: [(6, 0, 1)] }"
    still = dataclasses.replace(plain(background()[:1]))
    moving = made.particle_field(still, "moving").replace("point3f[] positions = ", "point3f[] unused = ")
    moving = moving.replace("quatf[]", sampled + "\n        quatf[]")
    hidden = made.particle_field(still, "hidden", extra='token visibility = "invisible"')
    other = 'def Mesh "m"\n{\n}\ndef DomeLight_1 "sky"\n{\n}'
    scene = opened(tmp_path / "a.usda", made.stage(moving + hidden + other))
    assert scene.static.mean_m.tolist() == [[5, 0, 1]]
    unknown = "\n".join(scene.provenance["unknown"])
    assert "/World/moving changes over time (positions)" in unknown
    assert "/World/hidden is not drawn: it is invisible" in unknown
    assert "not drawn: 1 DomeLight_1, 1 Mesh" in unknown


def test_defaults_of_what_a_field_may_leave_out(tmp_path):
    body = """def ParticleField3DGaussianSplat "a"
    {
        point3f[] positions = [(4, 1, 2), (5, 1, 2)]
        float3[] scales = [(1, 2, 3), (nan, 1, 1)]
        color3f[] primvars:displayColor = [(0.1, 0.2, 0.3)]
    }"""
    scene = opened(tmp_path / "a.usda", made.stage(body))
    assert scene.provenance["dropped"] == 1
    assert scene.static.quat_wxyz.tolist() == [[1, 0, 0, 0]] and scene.static.opacity.tolist() == [1]
    assert np.allclose(scene.static.rgb, [[0.1, 0.2, 0.3]]) and scene.static.label.tolist() == [Label.OTHER]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("float[] opacities = [", "float[] opacities = [0.5, "), r"opacities must be \(300,\), got \(301,\)"),
        (("Degree = 3", "Degree = 2"), "of degree 2 must be"),
        (("float3[] scales = ", "float[] scales = 1\n float3[] x = "), "no readable USD layer|cannot read it"),
        (("def Xform", "de Xform"), "no readable USD layer|cannot read it"),
        (("metersPerUnit = 1", "metersPerUnit = 0"), "metersPerUnit must be positive"),
        (("ParticleField3DGaussianSplat", "Points"), "holds no Gaussians. not drawn: 1 Points"),
    ],
)
def test_damaged_stages(tmp_path, change, text):
    data = made.stage(made.particle_field(background())).decode()
    assert change[0] in data
    with pytest.raises(ArchiveError, match=text) as caught:
        opened(tmp_path / "a.usda", data.replace(*change, 1).encode())
    assert str(tmp_path / "a.usda") in str(caught.value)
