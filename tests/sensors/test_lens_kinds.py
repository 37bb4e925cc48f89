"""Kinds of lenses: the shipped ones and that of docs/write_a_lens.md conform, and everything takes a new one."""

import dataclasses
import importlib.metadata
import json
import math
import re
import warnings
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import tiny_clip
from render_scenes import CAMERA_AXES, LENSES, cloud, psnr_db, request, row_of_walls, scene

from nurec_sim import logs
from nurec_sim.errors import ArchiveError, ClipError, RequestError
from nurec_sim.lenses import (
    BaseLens,
    Fisheye,
    Pinhole,
    check_lens,
    decode_parameters,
    encode_parameters,
    lens_class,
    lens_kinds,
    register_lens,
    registry,
)
from nurec_sim.render import make_renderer, spec
from nurec_sim.scene import read_scene, write_scene
from nurec_sim.scene.interop.nurec.sensor_models import camera_from
from nurec_sim.sensors import check_camera, fit_ftheta, scaled_camera
from nurec_sim.serving import wire
from nurec_sim.serving.wire import sensorsim
from nurec_sim.types import CameraModel, Rig

PAGE = (Path(__file__).parents[2] / "docs" / "write_a_lens.md").read_text(encoding="utf-8")
LENS_FILE, KIT = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(autouse=True)
def kinds(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(registry, "_classes", dict(registry._classes))
    register_lens(Sine)


@pytest.fixture
def double_sphere():
    """The class of docs/write_a_lens.md, registered."""
    names = {"__name__": "my_package"}
    exec(LENS_FILE, names)
    return names["DoubleSphere"]


@pytest.fixture
def camera(double_sphere):
    lens = double_sphere(24.0, 25.0, 36.0, 23.0, xi=-0.2, alpha=0.6)
    return CameraModel("front", 72, 48, lens, CAMERA_AXES)


# ------------------------------------------------------------------------------------------------------------- the kit


@pytest.mark.parametrize("kind", LENSES)
def test_shipped_lenses_conform(kind):
    assert check_lens(LENSES[kind], 72, 48) == []


def test_the_kit_of_the_page_finds_nothing(double_sphere):
    names = {"DoubleSphere": double_sphere, "CameraModel": CameraModel, "rig_from_camera": CAMERA_AXES}
    exec(KIT, names)
    check_camera(names["camera"])
    assert len(PAGE.splitlines()) <= 80


@pytest.mark.parametrize(("xi", "alpha"), [(0.0, 0.0), (0.3, 0.4), (-0.2, 0.6), (0.0, 0.5)])
def test_the_lens_of_the_page_conforms_with_any_parameters(double_sphere, xi, alpha):
    lens = double_sphere(240.0, 250.0, 320.0, 200.0, xi, alpha)
    assert check_lens(lens, 640, 400) == []
    ahead = np.array([[0.3, -0.2, 1.5]])
    if (xi, alpha) == (0.0, 0.0):  # a pinhole
        assert np.allclose(lens.project(ahead)[0], Pinhole(240.0, 250.0, 320.0, 200.0).project(ahead)[0])
    if (xi, alpha) == (0.3, 0.4):  # the paper's formula, by hand: d1 = 1.5427, xi d1 + z = 1.9628, d2 = 1.9956
        assert np.allclose(
            lens.project(ahead)[0], [[320 + 240 * 0.3 / 1.975954, 200 - 250 * 0.2 / 1.975954]], atol=1e-3
        )


@dataclasses.dataclass(frozen=True)
class Sine(BaseLens):
    """A sound lens for tests to break: r = sin(angle), up to 60 degrees."""

    kind: ClassVar[str] = "sine"

    fx_px: float = 60.0
    fy_px: float = 60.0
    cx_px: float = 36.0
    cy_px: float = 24.0
    max_angle_rad: float = math.pi / 3

    def project(self, xyz):
        unit = xyz / np.where(xyz.any(axis=1), np.linalg.norm(xyz, axis=1), 1.0)[:, None]
        valid = xyz.any(axis=1) & (unit[:, 2] >= 0.5)
        return unit[:, :2] * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px), valid

    def unproject(self, uv):
        flat = (uv - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        r2 = np.sum(flat**2, axis=1)
        return np.column_stack([flat, np.sqrt(np.maximum(1 - r2, 0))]), r2 <= 0.75


class WritesToItsInput(Sine):
    def project(self, xyz):
        xyz += 1
        return super().project(xyz - 1)


class WrongType(Sine):
    def unproject(self, uv):
        rays, valid = super().unproject(uv)
        return rays.astype(np.float32), valid.astype(np.uint8)


class LongRays(Sine):
    def unproject(self, uv):
        rays, valid = super().unproject(uv)
        return 2 * rays, valid


class NotItsInverse(Sine):
    def unproject(self, uv):
        return super().unproject(uv + 0.001)


class Folded(Sine):
    """Sees what is behind the camera where it sees what is in front."""

    def project(self, xyz):
        return super().project(np.column_stack([xyz[:, :2], np.abs(xyz[:, 2])]))


class LengthMatters(Sine):
    def project(self, xyz):
        uv, valid = super().project(xyz)
        return uv + np.linalg.norm(xyz, axis=1)[:, None] * 0.01, valid


class SeesTooFar(Sine):
    def project(self, xyz):
        uv, valid = super().project(xyz)
        return uv, valid | (xyz[:, 2] > 0)


class AxisElsewhere(Sine):
    def project(self, xyz):
        uv, valid = super().project(xyz)
        return uv + 1, valid

    def unproject(self, uv):
        return super().unproject(uv - 1)


class SeesItself(Sine):
    def project(self, xyz):
        uv, valid = super().project(xyz)
        return uv, valid | ~xyz.any(axis=1)


class NotScaled(Sine):
    def scaled(self, sx, sy):
        return dataclasses.replace(self, cx_px=self.cx_px * sx, cy_px=self.cy_px * sy)


class NotMirrored(Sine):
    def mirrored(self, width_px):
        return self


class NotAnIdealPinhole(Sine):
    @property
    def ideal_pinhole(self):
        return Pinhole(self.fx_px, self.fy_px, self.cx_px, self.cy_px)


class Warns(Sine):
    def project(self, xyz):
        warnings.warn("a division by zero", RuntimeWarning, stacklevel=1)
        return super().project(xyz)


class Raises(Sine):
    def unproject(self, uv):
        return super().unproject(uv[:, :3][:, [0, 1, 2]])


BROKEN = {
    WritesToItsInput: "project of 200: the input was written to",
    WrongType: r"unproject of 1271: the result must be float64 \(1271, 3\), got float32",
    LongRays: "unproject: rays must have length 1",
    NotItsInverse: r"project\(unproject\(pixel\) \* 1\) is off by 0.001px",
    Folded: r"unproject\(project\(ray\)\) is off by",
    LengthMatters: r"project\(unproject\(pixel\) \* 7\) is off",
    SeesTooFar: "rad off the axis is valid, but max_angle_rad is 1.0472",
    AxisElsewhere: r"the axis must meet the pixel \(cx_px, cy_px\) = \(36.0, 24.0\), got \[37.0, 25.0\]",
    SeesItself: "a point at the camera itself must not be valid",
    NotScaled: r"project of scaled\(1.5, 0.75\) is off",
    NotMirrored: r"project of mirrored\(80\) is off",
    NotAnIdealPinhole: "project of ideal_pinhole is off",
    Warns: "results: RuntimeWarning: a division by zero",
    Raises: "results: IndexError",
}


@pytest.mark.parametrize("broken", BROKEN)
def test_the_kit_names_what_is_broken(broken):
    assert check_lens(Sine(), 72, 48) == []
    broken.kind = "broken"
    register_lens(broken)
    faults = check_lens(broken(), 80, 48)
    assert any(re.search(BROKEN[broken], fault) for fault in faults), faults


def test_the_kit_asks_for_members_registration_and_sound_parameters():
    assert "lacks kind, perspective" in check_lens("pinhole")[0]
    assert check_lens(Pinhole(-1.0, 1.0, 0.0, 0.0)) == ["focal lengths must be positive, got -1.0, 1.0"]
    other = dataclasses.dataclass(frozen=True)(type("Other", (Sine,), {"kind": "other"}))
    assert "unknown lens model 'other'; known are ['fisheye'" in check_lens(other())[0]


# --------------------------------------------------------------------------------------------------------- the registry


def frozen(name, base=Sine, **members):
    return dataclasses.dataclass(frozen=True)(type(name, (base,), {"__module__": __name__, **members}))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: type("Plain", (BaseLens,), {"kind": "plain"}), "Plain must be a frozen dataclass"),
        (
            lambda: frozen("Bare", BaseLens, kind="bare"),
            "Bare lacks cx_px, cy_px, fx_px, fy_px, max_angle_rad, project",
        ),
        (lambda: frozen("Big", kind="Big Lens"), "kind must be lower-case letters, digits and underscores, got 'Big"),
        (lambda: frozen("Mine", kind="pinhole"), "Mine of kind 'pinhole': there is already Pinhole of kind 'pinhole'"),
        (lambda: frozen("Fisheye", kind="fish"), "Fisheye of kind 'fish': there is already Fisheye of kind 'fisheye'"),
        (
            lambda: frozen("Named", kind="named", label="", __annotations__={"label": str}),
            "Named.label: a parameter is a float, a tuple of floats or an enumeration, not <class 'str'>",
        ),
    ],
)
def test_what_cannot_be_registered_is_named(make, text):
    before = lens_kinds()
    with pytest.raises((TypeError, ValueError), match=re.escape(text)):
        register_lens(make())
    assert lens_kinds() == before


def test_a_class_that_is_defined_again_replaces_the_old_one():
    again = register_lens(frozen("Sine", kind="sine"))
    assert lens_class("sine") is lens_class("Sine") is again


def test_installed_lenses_are_found_when_asked_for(monkeypatch):
    found = frozen("Installed", kind="installed")
    point = SimpleNamespace(name="installed", load=lambda: found)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == "nurec_sim.lenses" else [])
    registry._register_installed.cache_clear()
    assert "installed" not in lens_kinds()
    assert lens_class("installed") is found
    registry._register_installed.cache_clear()
    bad = importlib.metadata.EntryPoint("bad", "no_such_package:Lens", "nurec_sim.lenses")
    monkeypatch.setattr(registry, "entry_points", lambda group: [bad])
    with pytest.raises(ValueError, match="lens 'bad' is installed but cannot be used: No module named"):
        lens_class("unheard of")
    assert lens_class("pinhole") is Pinhole  # others are read as before


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ([1.0], "must be a JSON object, got list"),
        ({"fx_px": 1}, "'fy_px' is missing; have ['fx_px']"),
        ({"k1": 1}, "unknown field 'k1'; known are ['fx_px', 'fy_px', 'cx_px', 'cy_px', 'radial', 'max_angle_rad']"),
        ({"fx_px": "1"}, "'fx_px' must be a finite number, got '1'"),
        ({"fx_px": True}, "'fx_px' must be a finite number, got True"),
        ({"fx_px": math.nan}, "'fx_px' must be a finite number, got nan"),
        ({"fx_px": 1, "fy_px": 1, "cx_px": 1, "cy_px": 1, "radial": 3}, "'radial' must be a list of numbers, got 3"),
    ],
)
def test_wrong_parameters_are_named(row, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        decode_parameters(Fisheye, row)


@pytest.mark.parametrize("kind", LENSES)
def test_parameters_come_back_from_json(kind):
    lens = LENSES[kind]
    assert decode_parameters(type(lens), json.loads(json.dumps(encode_parameters(lens))), complete=True) == lens


# --------------------------------------------------------------------------------------------- a new lens, everywhere


def test_a_clip_holds_a_new_lens(tmp_path, camera):
    rig = tiny_clip.rig()
    mine = dataclasses.replace(camera, width_px=64)
    rig = Rig({**rig.cameras, "front": mine}, rig.lidars, rig.body)
    path = tiny_clip.write(tmp_path / "clip", rig=rig)
    row = json.loads((path / "calib.json").read_text())["cameras"]["front"]["lens"]
    assert row == {"model": "double_sphere", "fx_px": 24.0, "fy_px": 25.0, "cx_px": 36.0, "cy_px": 23.0,
                   "xi": -0.2, "alpha": 0.6}  # fmt: skip
    clip = logs.open_clip(path)
    assert clip.rig.cameras["front"].lens == camera.lens
    assert ("front", "double_sphere") in [row[:2] for row in logs.describe_clip(clip).sensors]
    del registry._classes["double_sphere"]
    text = r"camera 'front'.*unknown lens model 'double_sphere'; known are .*'pinhole'.*, others must be registered"
    with pytest.raises(ClipError, match=text):
        logs.open_clip(path)
    with pytest.raises(ClipError, match=text):
        tiny_clip.write(tmp_path / "other", rig=rig)
    assert not (tmp_path / "other").exists()


def test_an_archive_holds_a_new_lens_and_its_fit(tmp_path, camera):
    world = dataclasses.replace(scene(row_of_walls([6.0])), rig=Rig({"front": camera}, {}))
    path = tmp_path / "scene.usdz"
    write_scene(world, path)
    assert read_scene(path).rig.cameras["front"].lens == camera.lens
    sidecar = zipfile.ZipFile(path).read("rig_trajectories.json")
    calibration = next(iter(json.loads(sidecar)["camera_calibrations"].values()))
    assert calibration["camera_model"]["type"] == "ftheta" and calibration["ftheta_fit_error_px"]["rms"] < 0.1
    assert calibration["exact_camera_model"]["type"] == "double_sphere"
    assert camera_from(calibration, "front").lens == camera.lens
    del registry._classes["double_sphere"]
    for call in (lambda: read_scene(path), lambda: write_scene(world, tmp_path / "other.usdz")):
        with pytest.raises(ArchiveError, match="lens: unknown lens model 'DoubleSphere'; known are"):
            call()
    assert not (tmp_path / "other.usdz").exists()


def test_messages_hold_a_new_lens_and_for_others_its_fit(camera):
    message = sensorsim.CameraSpec()
    wire.write_camera(camera, message)
    message = sensorsim.CameraSpec.FromString(message.SerializeToString())
    assert wire.read_camera(message, 72, 48, {}).lens == camera.lens
    assert wire.read_camera(message, 36, 12, {}).lens == scaled_camera(camera, 36, 12).lens
    message.ClearField("custom_lens")
    assert wire.read_camera(message, 72, 48, {}).lens == fit_ftheta(camera)


@pytest.mark.parametrize(
    ("kind", "parameters", "text"),
    [
        ("orb", "{}", "custom_lens: unknown lens model 'orb'; known are"),
        ("pinhole", "{", "custom_lens: Expecting property name"),
        ("pinhole", "[" * 60_000, "custom_lens: "),
        ("pinhole", " " * 70_000, "custom_lens: parameters may have 65536 characters, got 70000"),
        ("pinhole", '{"fx_px": 1}', "custom_lens: 'fy_px' is missing"),
        ("pinhole", '{"fx_px": -1, "fy_px": 1, "cx_px": 0, "cy_px": 0}', "focal lengths must be positive"),
    ],
)
def test_a_wrong_lens_in_a_message_is_named(kind, parameters, text):
    message = sensorsim.CameraSpec(resolution_w=8, resolution_h=8)
    message.custom_lens.kind, message.custom_lens.parameters = kind, parameters
    with pytest.raises(RequestError, match=text):
        wire.read_camera(message, 8, 8, {})


def test_a_scene_is_rendered_through_a_new_lens_as_the_reference_says(camera):
    world = scene(cloud(), sky=np.random.default_rng(1).random((6, 4, 4, 3)))
    asked = request(camera)
    frame, expected = make_renderer(world, device="cpu").render_camera(asked), spec.render_camera(world, asked)
    assert psnr_db(frame.rgb, expected.rgb) >= 60
    assert frame.rgb.std() > 10
