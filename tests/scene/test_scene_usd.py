"""OpenUSD's own validators and API agree with what we write: types, orders, times, poses, the sky."""

import dataclasses
import os
import re
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdLux, UsdSemantics, UsdValidation, UsdVol
from scene_worlds import END_US, START_US, empty_scene, full_scene

from nurec_sim import geometry
from nurec_sim.scene import read_scene, write_scene
from nurec_sim.scene.usd.dome_texture import encode_exr, latlong_directions, latlong_exr, sample_cubemap
from nurec_sim.types import Label

SH_C0 = 0.28209479177387814


@pytest.fixture(scope="module")
def scene():
    return full_scene()


@pytest.fixture(scope="module")
def path(scene, tmp_path_factory):
    return write_scene(scene, tmp_path_factory.mktemp("usd") / "a.usdz")


@pytest.fixture(scope="module")
def stage(path):
    return Usd.Stage.Open(str(path))


@pytest.mark.parametrize("make", [full_scene, empty_scene])
def test_validators_find_nothing_but_foreign_files(make, tmp_path):
    stage = Usd.Stage.Open(str(write_scene(make(), tmp_path / "a.usdz")))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    findings = [(error.GetName(), error.GetMessage()) for error in context.Validate(stage)]
    assert [f for f in findings if f[0] != "UnsupportedFileExtensionInPackage"] == []
    foreign = {re.search(r"extension '(\w+)'", text).group(1) for _, text in findings}
    assert {"yaml"} <= foreign <= {"json", "yaml", "npy", "ply", "xodr"}  # USD layers and the sky pass


def without_road():
    """No Gaussian is road: that field is empty."""
    scene = full_scene()
    return dataclasses.replace(scene, static=scene.static[scene.static.label != Label.ROAD])


def test_a_field_of_no_gaussians_is_not_on_the_stage_but_read(tmp_path):
    scene = without_road()
    path = write_scene(scene, tmp_path / "a.usdz")
    stage = Usd.Stage.Open(str(path))
    assert [str(prim.GetPath()) for prim in stage.Traverse() if "/Static/" in str(prim.GetPath())] == [
        "/World/Static/background"
    ]
    assert np.array_equal(read_scene(path).static.mean_m, scene.static.mean_m)


@pytest.mark.parametrize("make", [full_scene, without_road])
def test_nvidias_validator_passes(make, tmp_path):
    """VG.035 of the package omniverse-asset-validator: https://pypi.org/project/omniverse-asset-validator."""
    folders = os.pathsep.join([os.path.dirname(sys.executable), os.environ.get("PATH", "")])
    program = shutil.which("omni_asset_validate", path=folders)
    if program is None:
        pytest.skip("omni_asset_validate (pip install omniverse-asset-validator) is not on the PATH")
    path = write_scene(make(), tmp_path / "a.usdz")
    done = subprocess.run([program, "--requirement", "VG.035", str(path)], capture_output=True, text=True, timeout=300)
    assert "VG.035" not in done.stdout + done.stderr and done.returncode == 0, done.stdout + done.stderr


def test_package_is_stored_aligned_and_dated_alike(path):
    with zipfile.ZipFile(path) as package:
        entries = package.infolist()
        assert package.testzip() is None
    assert entries[0].filename == "default.usda"
    data = path.read_bytes()
    for entry in entries:
        name_length, extra_length = struct.unpack_from("<HH", data, entry.header_offset + 26)
        assert (entry.header_offset + 30 + name_length + extra_length) % 64 == 0
        assert struct.unpack_from("<H", data, entry.header_offset + 30 + name_length) == (0x1986,)
        assert entry.compress_type == zipfile.ZIP_STORED
        assert entry.date_time == (1980, 1, 1, 0, 0, 0)


def test_stage_units_and_times(stage):
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetTimeCodesPerSecond() == 1000
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, (END_US - START_US) / 1000)
    data = stage.GetRootLayer().customLayerData
    assert data["absoluteTimeOffsetMicroSec"] == START_US
    assert data["nurec_sim:sceneId"] == 'clip-é "7"'
    assert np.array_equal(np.array(data["nurec_sim:worldToNre"]), np.eye(4))


@pytest.mark.parametrize("name, is_road", [("background", False), ("road", True)])
def test_static_fields(scene, stage, name, is_road):
    prim = stage.GetPrimAtPath(f"/World/Static/{name}")
    field = UsdVol.ParticleField3DGaussianSplat(prim)
    wanted = scene.static[(scene.static.label == Label.ROAD) == is_road]
    assert np.array_equal(np.array(field.GetPositionsAttr().Get()), wanted.mean_m)
    quat = field.GetOrientationshAttr().Get()[0]
    assert (quat.real, *quat.imaginary) == tuple(wanted.quat_wxyz[0])
    assert np.array_equal(np.array(field.GetScaleshAttr().Get()), wanted.scale_m)
    assert np.array_equal(np.array(field.GetOpacitieshAttr().Get()), wanted.opacity)
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 2
    radiance = field.GetRadianceSphericalHarmonicsCoefficientshAttr()
    assert radiance.GetMetadata("elementSize") == 9
    assert UsdGeom.Primvar(radiance).GetInterpolation() == "vertex"
    coefficients = np.array(radiance.Get()).reshape(-1, 9, 3)
    assert np.allclose(0.5 + SH_C0 * coefficients[:, 0].astype(np.float64), wanted.rgb, atol=1e-6)
    assert np.array_equal(coefficients[:, 1:], wanted.sh_rest)
    low, high = np.array(field.GetExtentAttr().Get())
    assert (low <= wanted.mean_m.min(axis=0)).all() and (high >= wanted.mean_m.max(axis=0)).all()
    assert (high - low < np.ptp(wanted.mean_m, axis=0) + 6 * 0.3 + 1e-3).all()
    normal = UsdGeom.PrimvarsAPI(prim).GetPrimvar("nurec_sim:normal")
    assert normal.GetInterpolation() == "vertex"
    assert np.array_equal(np.array(normal.Get()), wanted.normal)
    assert not any(attribute.ValueMightBeTimeVarying() for attribute in prim.GetAttributes())


def code(t_us):
    return (t_us - START_US) / 1000


def windows(stage):
    for prim in stage.Traverse():
        if prim.GetTypeName() == "ParticleField3DGaussianSplat" and "Actors" in str(prim.GetPath()):
            yield UsdVol.ParticleField3DGaussianSplat(prim)


def test_windows_move_and_appear(scene, stage):
    """At any time the visible windows hold exactly the Gaussians between their knots, on straight lines."""
    dynamic = scene.dynamic
    for t_us in START_US + np.array([0, 250_000, 500_000, 750_000, 1_000_001, 1_500_003, 1_600_000]):
        seen = {}
        for field in windows(stage):
            if UsdGeom.Imageable(field).ComputeVisibility(code(t_us)) == "invisible":
                continue
            index = UsdGeom.PrimvarsAPI(field).GetPrimvar("nurec_sim:index").Get()
            seen |= dict(zip(index, np.array(field.GetPositionsAttr().Get(code(t_us))), strict=True))
        alive = (dynamic.knot_t_us[:, 0] <= t_us) & (t_us <= dynamic.knot_t_us[:, 2])
        assert sorted(seen) == np.flatnonzero(alive).tolist()
        for index, position in seen.items():
            times, knots = dynamic.knot_t_us[index] - START_US, dynamic.knot_m[index]
            wanted = [np.interp(t_us - START_US, times, knots[:, axis]) for axis in range(3)]
            assert np.allclose(position, wanted, atol=1e-4)


def test_windows_belong_to_their_tracks(scene, stage):
    owners = {}
    for field in windows(stage):
        parent = field.GetPrim().GetParent()
        track_id = parent.GetAttribute("nurec_sim:trackId").Get() if parent.GetName() != "untracked" else None
        for index in UsdGeom.PrimvarsAPI(field).GetPrimvar("nurec_sim:index").Get():
            owners[index] = track_id
    ids = [track.id for track in scene.tracks] + [None]
    assert [owners[i] for i in range(len(scene.dynamic))] == [ids[track] for track in scene.dynamic.track]


def test_actor_boxes_follow_their_tracks(scene, stage):
    actors = {
        prim.GetAttribute("nurec_sim:trackId").Get(): prim
        for prim in stage.GetPrimAtPath("/World/Actors").GetChildren()
        if prim.GetAttribute("nurec_sim:trackId")
    }
    assert sorted(actors) == ["1/car", "1:car"]  # ids that USD would spell alike
    for track in scene.tracks:
        prim = actors[track.id]
        assert list(UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()) == [track.label]
        box = UsdGeom.Cube(prim.GetChild("box"))
        for t_us in (START_US, START_US + 1_234_567, track.path.end_us):
            world_from_box = np.array(box.ComputeLocalToWorldTransform(code(t_us))).T
            wanted = track.path.at(t_us) @ np.diag([*track.size_m, 1])
            assert np.allclose(world_from_box, wanted, atol=1e-5)


def test_cameras_ride_on_the_rig(scene, stage):
    t_us = START_US + 987_654
    for camera_id, camera in scene.rig.cameras.items():
        prim = UsdGeom.Camera.Get(stage, f"/World/Rig/{camera_id}")
        world_from_usd = np.array(prim.ComputeLocalToWorldTransform(code(t_us))).T
        wanted = scene.ego.at(t_us) @ camera.rig_from_camera
        assert np.allclose(world_from_usd[:3, 3], wanted[:3, 3], atol=1e-5)
        assert np.allclose(world_from_usd[:3, :3] @ [0, 0, -1], wanted[:3, 2], atol=1e-5)  # both look ahead
        assert np.allclose(world_from_usd[:3, :3] @ [0, 1, 0], -wanted[:3, 1], atol=1e-5)  # USD's y is up
        assert prim.GetPrim().GetAttribute("cameraProjectionType").Get() == "fisheyePolynomial"


def test_camera_frustum_is_the_pinhole(scene, stage):
    """A point projects to the same pixel through USD's frustum as through the undistorted pinhole."""
    camera = scene.rig.cameras["roof"]
    frustum = UsdGeom.Camera.Get(stage, "/World/Rig/roof").GetCamera(0).frustum
    xyz = np.array([1.1, -0.4, 5.0])
    x, y, z = frustum.ComputeProjectionMatrix().Transform((xyz * [1, -1, -1]).tolist())
    uv = [(x + 1) / 2 * camera.width_px, (1 - y) / 2 * camera.height_px]
    lens = camera.lens
    wanted = [lens.fx_px * xyz[0] / xyz[2] + lens.cx_px, lens.fy_px * xyz[1] / xyz[2] + lens.cy_px]
    assert np.allclose(uv, wanted, atol=1e-2)


def test_sky_dome(stage):
    dome = UsdLux.DomeLight_1.Get(stage, "/World/Sky")
    assert dome.GetTextureFormatAttr().Get() == "latlong"
    assert dome.GetPoleAxisAttr().Get() == "Z"
    assert dome.GetTextureFileAttr().Get().resolvedPath.endswith("a.usdz[sky/envmap_latlong.exr]")


def decode_exr(data):
    """A reader for half-float scan lines with channels B, G, R, compressed by ZIP in blocks of 16 lines."""
    assert struct.unpack_from("<II", data) == (20000630, 2)
    position, attributes = 8, {}
    while data[position]:
        name_end = data.index(0, position)
        kind_end = data.index(0, name_end + 1)
        (size,) = struct.unpack_from("<I", data, kind_end + 1)
        attributes[data[position:name_end].decode()] = data[kind_end + 5 : kind_end + 5 + size]
        position = kind_end + 5 + size
    _, _, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    assert attributes["compression"] == b"\3"
    height, width = bottom + 1, right + 1
    offsets = np.frombuffer(data, "<u8", -(-height // 16), position + 1)
    rows = []
    for block, offset in enumerate(offsets.tolist()):
        first, size = struct.unpack_from("<ii", data, offset)
        assert first == 16 * block
        packed = data[offset + 8 : offset + 8 + size]
        wanted = min(16, height - first) * width * 6
        if size < wanted:
            differences = np.frombuffer(zlib.decompress(packed), np.uint8).astype(np.int64)
            differences[1:] -= 128
            planes = (np.cumsum(differences) % 256).astype(np.uint8)
            packed = np.stack([planes[: len(planes) // 2], planes[len(planes) // 2 :]], axis=1).tobytes()
        rows.append(np.frombuffer(packed, "<f2").reshape(-1, 3, width))
    assert offset + 8 + size == len(data)
    return np.concatenate(rows)[:, ::-1].transpose(0, 2, 1)


def test_exr_round_trip():
    """Noise is stored as it is, what is smooth in less; the last block has fewer lines."""
    for image in (np.random.default_rng(0).random((3, 5, 3)), np.linspace(0, 1, 37 * 41 * 3).reshape(37, 41, 3)):
        image = image.astype(np.float16)
        assert np.array_equal(decode_exr(encode_exr(image)), image)
    assert len(encode_exr(image)) < image.nbytes * 0.7


def test_sky_texture_shows_the_sky_where_the_dome_expects_it():
    """Paint a direction into the cubemap, find it in the texture: row from the pole, column by the OpenEXR rule."""
    size = 32
    for azimuth, elevation in ((0.0, 0.1), (2.0, 0.8), (-1.5, -0.6), (np.pi / 2, 0.0)):
        axis = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        sky = (np.clip(geometry.cubemap_directions(size) @ axis, 0, 1) ** 200).astype(np.float32)
        image = decode_exr(latlong_exr(np.repeat(sky[..., None], 3, axis=-1)))
        row, column = np.unravel_index(np.argmax(image[..., 0]), image.shape[:2])
        longitude = np.arctan2(axis[0], -axis[1])  # 0 along -y, pi/2 along +x
        assert abs(row + 0.5 - (np.pi / 2 - elevation) / np.pi * 2 * size) < 1.5
        error = column + 0.5 - (np.pi - longitude) / (2 * np.pi) * 4 * size
        assert min(abs(error), 4 * size - abs(error)) < 1.5


def test_sky_colours_become_linear():
    image = decode_exr(latlong_exr(np.full((6, 4, 4, 3), 0.5, np.float32)))
    assert np.allclose(image.astype(float), 0.21404, atol=2e-4)


def test_cubemap_sampling_meets_the_texels():
    sky = np.random.default_rng(0).random((6, 4, 4, 3), np.float32)
    assert np.allclose(sample_cubemap(sky, geometry.cubemap_directions(4)), sky)
    assert np.allclose(np.linalg.norm(latlong_directions(8), axis=-1), 1)
