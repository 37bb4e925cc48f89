"""Every rule of every consumer: break exactly that in a good archive, and exactly its line appears."""

import dataclasses
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scene_worlds import START_US, full_scene
from spoilt_archives import SIDECAR_BREAKS, Members, complete_scene, hashed, members_of, put

from nurec_sim.files.zip_package import write_package
from nurec_sim.scene import archive, write_scene
from nurec_sim.scene.interop.validate import RULES, openusd, validate_archive
from nurec_sim.scene.usd.layers import static_layer
from nurec_sim.types import Gaussians, GaussianScene, Label, Rig, Trajectory

pytestmark = pytest.mark.usefixtures("quick_maps")


@pytest.fixture(scope="module")
def members(tmp_path_factory) -> Members:
    return members_of(complete_scene(), tmp_path_factory.mktemp("validate"))


def rules_of(path: Path) -> set[str]:
    return {f"{finding.consumer} {finding.rule}" for finding in validate_archive(path)}


def test_a_complete_archive_has_nothing_to_say(members, tmp_path):
    write_package(tmp_path / "a.usdz", members)
    assert validate_archive(tmp_path / "a.usdz") == []


@pytest.mark.parametrize("spoil, wanted", SIDECAR_BREAKS.values(), ids=SIDECAR_BREAKS)
def test_each_break_of_a_sidecar_has_its_line(members, tmp_path, spoil, wanted):
    write_package(tmp_path / "a.usdz", hashed(spoil(members)))
    assert rules_of(tmp_path / "a.usdz") == wanted


# -------------------------------------------------------------------------------------------------- layers and splats


def root(old: bytes, new: bytes):
    """Changes the text of the root layer."""

    def spoil(members):
        assert old in members["default.usda"]
        return members | {"default.usda": members["default.usda"].replace(old, new)}

    return spoil


def splats(**changes):
    """Another layer of static Gaussians, some of their columns changed."""

    def spoil(members):
        static = complete_scene().static
        columns = {name: change(getattr(static, name)) for name, change in changes.items()}
        return members | {archive.STATIC_LAYER: static_layer(dataclasses.replace(static, **columns))}

    return spoil


def splat_prim(change):
    """Changes a splat prim through OpenUSD."""

    def spoil(members):
        from pxr import Sdf

        layer = Sdf.Layer.CreateAnonymous(".usda")
        prim = 'def ParticleField3DGaussianSplat "a"\n{\n' + change + "\n}\n"
        assert layer.ImportFromString(BARE.decode().replace("World", "Static").replace("{\n}", "{\n" + prim + "}"))
        changed = root(b"splats_static.usdc", b"more.usda")(members)
        return changed | {"more.usda": layer.ExportToString().encode()}

    return spoil


TWO = """
        point3f[] positions = [(0, 0, 0), (1, 0, 0)]
        quatf[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]
        float3[] scales = [(1, 1, 1), (1, 1, 1)]
        float[] opacities = [1, 0.5]
        uniform int radiance:sphericalHarmonicsDegree = 1
        float3[] radiance:sphericalHarmonicsCoefficients = [(0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0),
                                                            (0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0)] (
            elementSize = 4
            interpolation = "vertex"
        )
        float3[] extent = [(-3, -3, -3), (4, 3, 3)]"""
NONE = """
        point3f[] positions = []
        quatf[] orientations = []
        float3[] scales = []
        float[] opacities = []
        uniform int radiance:sphericalHarmonicsDegree = 0
        float3[] radiance:sphericalHarmonicsCoefficients = []
        float3[] extent = [(0, 0, 0), (0, 0, 0)]"""
BARE = b'#usda 1.0\n(\n    defaultPrim = "World"\n    upAxis = "Z"\n    metersPerUnit = 1\n)\ndef Xform "World"\n{\n}\n'

USD_BREAKS = {
    "no default prim": (root(b'defaultPrim = "World"', b""), {"openusd default-prim"}),
    "y is up": (root(b'upAxis = "Z"', b'upAxis = "Y"'), {"openusd units"}),
    "no axis": (root(b'upAxis = "Z"', b""), {"openusd units"}),
    "centimetres": (root(b"metersPerUnit = 1", b"metersPerUnit = 0.01"), {"openusd units"}),
    "a reference that leaves": (root(b"@./cameras.usdc@", b"@../cameras.usdc@"), {"openusd self-contained"}),
    "an absolute reference": (root(b"@./cameras.usdc@", b"@/etc/cameras.usdc@"), {"openusd self-contained"}),
    "a package in the package": (root(b"@./cameras.usdc@", b"@./cameras.usdz@"), {"openusd nested"}),
    "a layer that is none": (put("cameras.usdc", b"PXR-USDC" + bytes(80)), {"openusd opens"}),
    "a root that is none": (put("default.usda", b"#usda 1.0\ndef {"), {"openusd opens"}),
    "a texture that is not there": (root(b"envmap_latlong", b"other"), {"openusd validators"}),
    "a texture of this machine": (root(b"./sky/envmap_latlong.exr", __file__.encode()), {"openusd advice"}),
    "no splats": (put("default.usda", BARE), {"openusd splats"}),
    "good splats": (splat_prim(TWO), set()),
    "an opacity too few": (splat_prim(TWO.replace("[1, 0.5]", "[1]")), {"openusd splat-arrays"}),
    "coefficients of another degree": (splat_prim(TWO.replace("Degree = 1", "Degree = 2")), {"openusd splat-arrays"}),
    "no extent": (splat_prim(TWO.replace("float3[] extent", "float3[] other")), {"openusd splat-bounds"}),
    "another element size": (splat_prim(TWO.replace("Size = 4", "Size = 3")), {"openusd splat-bounds"}),
    "harmonics that are constant": (
        splat_prim(TWO.replace('interpolation = "vertex"', "")),
        {"openusd vg-035"},
    ),
    "a flat splat": (splat_prim(TWO.replace("[(1, 1, 1), ", "[(1, 0, 1), ")), {"openusd vg-035"}),
    "a prim without splats": (splat_prim(NONE), {"openusd vg-035"}),
    "short quaternions": (splats(quat_wxyz=lambda quat: quat / 2), {"openusd splat-arrays", "own reads"}),
    "opacities above one": (splats(opacity=lambda opacity: opacity * 9), {"openusd splat-arrays", "own reads"}),
    "infinite means": (splats(mean_m=lambda mean: mean * np.float32(np.inf)), {"openusd splat-arrays", "own reads"}),
    "facts of nothing": (put(archive.FACTS, b"{}"), {"own reads"}),
    "no road": (splats(label=lambda label: np.full_like(label, Label.OTHER)), {"own road"}),
    "no intensity": (splats(intensity=lambda intensity: np.full_like(intensity, np.nan)), {"own intensity"}),
}


@pytest.mark.parametrize("spoil, wanted", USD_BREAKS.values(), ids=USD_BREAKS)
def test_each_break_of_the_scene_has_its_line(members, tmp_path, spoil, wanted, capfd):
    write_package(tmp_path / "a.usdz", hashed(spoil(members)))
    assert rules_of(tmp_path / "a.usdz") == wanted


def nothing(scene: GaussianScene) -> GaussianScene:
    return dataclasses.replace(scene, static=Gaussians.empty(), dynamic=scene.dynamic.empty())


POOR_SCENES = {
    "no Gaussians": (nothing, {"openusd splats", "own gaussians", "own intensity"}),
    "no camera": (
        lambda scene: dataclasses.replace(scene, rig=Rig({}, {}), camera_times_us={}),
        {"alpasim calibrations", "carla calibrations", "own cameras"},
    ),
    "one pose": (
        lambda scene: dataclasses.replace(scene, ego=Trajectory(np.array([START_US]), np.eye(4)[None])),
        {"own drive"},
    ),
    "an import": (
        lambda scene: dataclasses.replace(scene, provenance={"unknown": ["no sky: it is black"]}),
        {"own known"},
    ),
}


@pytest.mark.parametrize("make, wanted", POOR_SCENES.values(), ids=POOR_SCENES)
def test_what_a_sound_scene_cannot_do(make, wanted, tmp_path):
    assert rules_of(write_scene(make(complete_scene()), tmp_path / "a.usdz")) == wanted


def test_a_lens_that_no_polynomial_fits(tmp_path):
    assert rules_of(write_scene(full_scene(), tmp_path / "a.usdz")) == {"carla polynomials-agree"}


# -------------------------------------------------------------------------------------------------------- the package


def zipped(path: Path, members: Members, compression: int = zipfile.ZIP_STORED) -> Path:
    """The members in a ZIP by Python's own writer: not aligned."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as package:
        for name, data in members.items():
            package.writestr(name, data)
    path.write_bytes(buffer.getvalue())
    return path


def package_breaks(members: Members, folder: Path) -> dict[str, tuple[Path, set[str]]]:
    sidecars_first = dict(sorted(members.items(), key=lambda item: item[0] != "metadata.yaml"))
    write_package(folder / "last.usdz", sidecars_first)
    write_package(folder / "a.zip", members)
    write_package(folder / "changed.usdz", members | {"mesh.ply": members["mesh.ply"] + b" "})
    (folder / "text.usdz").write_bytes(b"no archive")
    everyone = {"alpasim zip", "carla zip", "openusd zip", "own reads"}
    return {
        "not aligned": (zipped(folder / "askew.usdz", members), {"openusd aligned"}),
        "compressed": (
            zipped(folder / "packed.usdz", members, zipfile.ZIP_DEFLATED),
            {"openusd stored", "openusd aligned", "own reads"},
        ),
        "the root layer is not first": (folder / "last.usdz", {"openusd first-layer"}),
        "another suffix": (folder / "a.zip", {"alpasim name", "openusd opens", "own reads"}),
        "a changed sidecar": (folder / "changed.usdz", {"own unchanged"}),
        "no archive": (folder / "text.usdz", everyone),
        "not there": (folder / "none.usdz", everyone),
    }


PACKAGE_BREAKS = ("not aligned", "compressed", "the root layer is not first", "another suffix", "a changed sidecar",
                  "no archive", "not there")  # fmt: skip


@pytest.mark.parametrize("name", PACKAGE_BREAKS)
def test_each_break_of_the_package_has_its_line(name, members, tmp_path):
    path, wanted = package_breaks(members, tmp_path)[name]
    assert rules_of(path) == wanted


def test_a_package_beyond_four_gigabytes(members, tmp_path, monkeypatch):
    write_package(tmp_path / "a.usdz", members)
    monkeypatch.setattr(openusd, "MAX_PACKAGE_BYTES", 1000)
    assert rules_of(tmp_path / "a.usdz") == {"openusd size"}


def test_every_rule_is_broken_here(members, tmp_path):
    tables = (SIDECAR_BREAKS, USD_BREAKS, POOR_SCENES, package_breaks(members, tmp_path))
    broken = {rule for table in tables for _, wanted in table.values() for rule in wanted} | {"openusd size"}
    assert broken == {f"{consumer} {rule}" for consumer, rules in RULES.items() for rule in rules}
