"""Methods of others: loaded, given settings, checked, evaluated; the document's example is one of them."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from doc_examples import example, names_of
from reconstruct_street import Street, camera

from nurec_sim import plugins
from nurec_sim.cli.scenes import NO_FLAGS, method_settings, refinement
from nurec_sim.errors import GpuError, NurecSimError, ReconstructError
from nurec_sim.evaluate import contenders
from nurec_sim.evaluate.methods import describe
from nurec_sim.reconstruct import FeedForwardSettings, LiftSettings, OptimizeSettings, available_methods, reconstruct
from nurec_sim.reconstruct.conformance import check_method
from nurec_sim.serving.store.recipes import Recipe, content_key


@pytest.fixture(scope="module")
def dots() -> type:
    return names_of("write_a_method.md")["Dots"]


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "dots.py"
    path.write_text(example("write_a_method.md"))
    return path


@pytest.fixture
def street() -> Street:
    return Street(frames=2, cameras=(camera(), camera("left", 0.5)))


def test_the_documents_example_keeps_the_contract(dots, street):
    assert check_method(dots(), street) == []


def test_a_method_is_given_as_an_object_or_by_its_file(dots, street, file):
    scene = reconstruct(street, dots(), settings=dots.settings(every=50))
    (first, second) = (street.sweep("top", index).xyz_world_m[::50] for index in (0, 1))
    assert np.array_equal(scene.static.mean_m, np.concatenate([first, second]).astype(np.float32))
    assert scene.provenance == {"method": "dots", "cameras": ["front", "left"]}
    assert len(reconstruct(street, f"{file}:Dots", hold_out_sweeps=[0]).static) < len(
        reconstruct(street, str(file)).static
    )
    with pytest.raises(ReconstructError, match="method 'dots' takes DotSettings, got LiftSettings"):
        reconstruct(street, dots(), settings=LiftSettings())


def test_installed_methods_are_listed_and_compared(dots, file, monkeypatch):
    class Point:
        name = "dots"

        def load(self):
            return dots

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point()] if group == "nurec_sim.methods" else [])
    assert available_methods() == ["dense", "dots", "lidar", "lift", "optimized", "selective"]
    one, two = contenders(("dots", "copy"))
    assert (one.name, one.settings) == ("dots", dots.settings()) and two.name == "copy"
    assert describe(one) == {"method": "dots", "actors": "auto", "settings": {"every": 10, "radius_m": 0.1}}
    (by_file,) = contenders((str(file),))
    assert by_file.name == "dots"
    with pytest.raises(
        ReconstructError, match=r"have \['dense', 'dots', 'lidar', 'lift'.*or one of \['dense'.*'copy'\]"
    ):
        contenders(("dosts",))
    with pytest.raises(ReconstructError, match="each once"):
        contenders(("dots", str(file)))


def test_kept_scenes_depend_on_the_file_of_the_method(file, tmp_path):
    log = tmp_path / "log.zip"
    log.write_bytes(b"log")
    keys = {content_key(log, Recipe(str(file))), content_key(log, Recipe("lift"))}
    assert {key.split("-")[1] for key in keys} == {"dots", "lift"}
    file.write_text(file.read_text().replace("0.9", "0.8"))
    assert content_key(log, Recipe(str(file))) not in keys


def test_settings_from_the_command_line(file):
    assert method_settings("lift", NO_FLAGS) is None and method_settings("dense", NO_FLAGS) == FeedForwardSettings()
    lift = method_settings("lift", NO_FLAGS, ["sky_px=64", "views.levels=48", "points.carve=no"])
    assert (lift.sky_px, lift.views.levels, lift.points.carve, lift.opacity) == (64, 48, False, LiftSettings().opacity)
    own = method_settings(f"{file}:Dots", NO_FLAGS, ["every=3"])
    few = reconstruct(Street(frames=1), str(file), settings=own)  # the file is loaded again, its classes are the same
    assert own.every == 3 and len(few.static) == -(-len(Street(frames=1).sweep("top", 0).xyz_m) // 3)
    dense = method_settings(
        "dense", dataclasses.replace(NO_FLAGS, frames=4), ["max_gaussians=none", "merge=concatenate"]
    )
    assert (dense.frames, dense.max_gaussians, dense.merge) == (4, None, "concatenate")
    for given, text in [
        ("sky_px", r"--set takes NAME=VALUE, got 'sky_px'"),
        ("sky=1", r"--set: there is no setting 'sky'; have \['colours', 'detail_px', 'duration_s', 'ground'"),
        ("views.sky=1", r"there is no setting 'views.sky'; have \['budget'"),
        ("sky_px.a=1", r"there is no setting 'sky_px.a'"),
        ("sky_px=x", r"--set sky_px=x: Input should be a valid integer"),
    ]:
        with pytest.raises(NurecSimError, match=text):
            method_settings("lift", NO_FLAGS, [given])
    with pytest.raises(NurecSimError, match="overlap must lie in 0..0.5, got 3"):
        method_settings("dense", NO_FLAGS, ["overlap=3"])
    with pytest.raises(NurecSimError, match="method 'lift' does not use --frames"):
        method_settings("lift", dataclasses.replace(NO_FLAGS, frames=4))


def test_device_and_budget_are_those_of_an_optimisation_too():
    on_cpu, on_none = (dataclasses.replace(NO_FLAGS, device=name) for name in ("cpu", "cuda:99"))
    assert (
        method_settings("optimized", on_cpu) == OptimizeSettings(device="cpu") and refinement(None, "cuda:99") is None
    )
    assert refinement(7.0, "cpu") == OptimizeSettings(seconds=7.0, device="cpu")
    # With --refine its settings are those of the method, or it would have them twice.
    assert method_settings("optimized", on_cpu, refine=7.0) is None is method_settings("optimized", NO_FLAGS)
    assert method_settings("lift", on_cpu, refine=7.0) is None is method_settings("lift", on_cpu, renders=True)
    with pytest.raises(NurecSimError, match="method 'lift' does not use --device"):
        method_settings("lift", on_cpu)
    assert method_settings("optimized", NO_FLAGS, budget=9).max_gaussians == 9
    assert refinement(7.0, "cpu", 9) == OptimizeSettings(seconds=7.0, device="cpu", max_gaussians=9)
    assert method_settings("lift", NO_FLAGS, refine=7.0, budget=9) is None
    with pytest.raises(NurecSimError, match="--budget bounds .* give it with --refine or --method optimized"):
        method_settings("lift", NO_FLAGS, budget=9)
    # Before the start of minutes of reconstruction.
    for call in (lambda: refinement(7.0, "cuda:99"), lambda: method_settings("optimized", on_none)):
        with pytest.raises(GpuError, match="device 'cuda:99' cannot be used"):
            call()


@dataclass(frozen=True)
class Bare:
    size: int


def spoilt(dots: type, **parts) -> object:
    return type("Spoilt", (dots,), parts)()


def reads_all(self, clip, settings, *, cameras, hold_out_sweeps, progress):
    clip.image("left", 0), clip.sweep("top", 0)
    return super(type(self), self).reconstruct(
        clip, settings, cameras=cameras, hold_out_sweeps=(), progress=lambda stage, done: progress(stage, 2 * done)
    )


def changes_id(self, clip, settings, **asked):
    return dataclasses.replace(super(type(self), self).reconstruct(clip, settings, **asked), id="other", tracks=())


def is_random(self, clip, settings, **asked):
    scene = super(type(self), self).reconstruct(clip, settings, **asked)
    scene.static.mean_m[0] = np.random.default_rng().random(3)
    return scene


@pytest.mark.parametrize(
    "parts, text",
    [
        ({"settings": Bare}, "settings Bare needs a docstring"),
        ({"settings": Bare}, "setting 'size' needs a default"),
        ({"settings": int}, "settings must be a frozen dataclass, got <class 'int'>"),
        ({"name": None}, "it lacks name (str)"),
        ({"files": lambda self, settings: ["a"]}, "files() must give pathlib.Path objects, got ['a']"),
        ({"reconstruct": reads_all}, "an image of camera 'left' was read, which is not among the cameras given"),
        ({"reconstruct": reads_all}, "sweep 0 of LiDAR 'top' was read, which is held out"),
        ({"reconstruct": changes_id}, "the scene's id must be that of the log, 'street', got 'other'"),
        ({"reconstruct": lambda self, clip, settings, **_: 1 / 0}, "it fails with ZeroDivisionError"),
        ({"reconstruct": is_random}, "a second run gave another scene"),
    ],
)
def test_the_kit_says_what_to_mend(dots, street, parts, text):
    assert any(text in fault for fault in check_method(spoilt(dots, **parts), street))
