"""Per-scene optimisation: what it makes of a street, interrupted, resumed and killed."""

import dataclasses
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_clip
from fitted_street import SMALL, image_of
from gpu_on_cpu.places import PLACES, launcher_at

from nurec_sim import cli, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.scores.images import psnr
from nurec_sim.reconstruct import OptimizeSettings, reconstruct
from nurec_sim.reconstruct.optimize import method
from nurec_sim.reconstruct.optimize.checkpoint import write_checkpoint
from nurec_sim.reconstruct.optimize.frames import cpu_frames
from nurec_sim.reconstruct.optimize.merged import merged
from nurec_sim.reconstruct.optimize.parameters import Parameters
from nurec_sim.reconstruct.optimize.responses import FrameResponses
from nurec_sim.reconstruct.optimize.settings import LearningRates, LossWeights, PosePriors, StartPriors
from nurec_sim.reconstruct.optimize.views import training_views
from nurec_sim.render.gpu.frame import GpuFrames
from nurec_sim.scene import read_scene, scene_hash, write_scene
from nurec_sim.scene.precision import archived


@pytest.fixture(scope="module")
def fitted(street, lifted):
    return method.refine(lifted, street, ["front"], set(), lambda *_: None, OptimizeSettings(seconds=None, steps=60))


def mean_psnr(scene, clip, name):
    return np.mean([psnr(image_of(scene, clip, name, k), clip.image(name, k)) for k in range(clip.frames)])


def test_seen_and_unseen_images_gain(street, lifted, fitted):
    assert mean_psnr(fitted, street, "front") > mean_psnr(lifted, street, "front") + 2
    assert mean_psnr(fitted, street, "beside") > mean_psnr(lifted, street, "beside") + 1


def test_a_frame_taken_brighter_has_a_response_of_its_own(fitted):
    bright, usual = fitted.exposures["front"][1], fitted.exposures["front"][2]
    assert np.diag(bright[:, :3]).mean() / np.diag(usual[:, :3]).mean() == pytest.approx(1.2, abs=0.06)
    assert fitted.exposures["beside"] == pytest.approx(fitted.exposures["front"]), "a camera of the same kind"
    assert fitted.provenance["refined"]["borrowed_responses"] == ["beside"]


def test_the_same_steps_give_the_same_bytes_and_an_archive_keeps_them(street, lifted, fitted, tmp_path):
    few = OptimizeSettings(seconds=None, steps=3)
    one, two = (method.refine(lifted, street, ["front"], set(), lambda *_: None, few) for _ in range(2))
    assert scene_hash(one) == scene_hash(two) != scene_hash(dataclasses.replace(one, exposures={}))
    write_scene(fitted, tmp_path / "a.usdz")
    back = read_scene(tmp_path / "a.usdz")
    kept = archived(fitted)
    assert scene_hash(back) == scene_hash(kept) and back.exposures.keys() == {"front", "beside"}
    assert np.array_equal(image_of(back, street, "front", 1), image_of(kept, street, "front", 1))


def test_a_fit_begins_with_fewer_gaussians(street, lifted):
    few = OptimizeSettings(seconds=None, steps=3)
    before = len(lifted.static)
    scene = method.refine(lifted, street, ["front"], set(), lambda *_: None, few)
    # fx is 120 pixels: 5 of them are 0.42 m 10 m away, more than the largest voxel.
    assert scene.provenance["merged"] == {"from": before, "voxel_m": 0.07} and len(scene.static) < before
    cells = np.rint(lifted.static.mean_m.astype(float) / 0.07).astype(int)
    alike = len(np.unique(np.column_stack([cells, lifted.static.label]), axis=0))
    assert len(scene.static) == alike
    whole = method.refine(
        lifted, street, ["front"], set(), lambda *_: None, dataclasses.replace(few, voxel_px=0.0, max_gaussians=before)
    )
    assert len(whole.static) == before and "merged" not in whole.provenance


def test_a_budget_of_gaussians_is_kept(lifted):
    cameras, before = [lifted.rig.cameras["front"]], len(lifted.static)
    fine = merged(lifted, cameras, 0.5)
    assert fine.provenance["merged"]["voxel_m"] == pytest.approx(0.5 * 10 / 120, rel=0.1)
    coarse = sensors.scaled_camera(cameras[0], 64, 32)
    assert merged(lifted, [coarse, *cameras], 0.5).provenance == fine.provenance, "the finest camera counts"
    half = merged(lifted, cameras, 0.5, before // 2)
    assert 0.9 * before // 2 <= len(half.static) <= before // 2 < len(fine.static)
    assert half.provenance["merged"]["voxel_m"] > fine.provenance["merged"]["voxel_m"]
    assert len(merged(lifted, cameras, 0.5, len(fine.static)).static) == len(fine.static)
    with pytest.raises(ReconstructError, match="max_gaussians: a budget of 1 is less than the number of labels, 2"):
        merged(lifted, cameras, 0.5, 1)


def test_frames_begin_with_the_response_that_the_scene_comes_with(lifted):
    """No frame is fitted: the responses are those of the scene, per frame, not those of the camera."""
    darker = np.stack([np.hstack([np.eye(3) * (0.5 + 0.1 * k), np.full((3, 1), 0.01)]) for k in range(4)])
    responses = FrameResponses(dataclasses.replace(lifted, exposures={"front": darker}), {"front": 4, "beside": 1})
    responses.start("front", 2, np.full((4, 4, 3), 0.2, np.float32), np.full((4, 4, 3), 0.4, np.float32))
    assert responses.of("front", 2) == pytest.approx(darker[2])
    responses.start("beside", 0, np.full((4, 4, 3), 0.2, np.float32), np.full((4, 4, 3), 0.3, np.float32))
    given = np.asarray(lifted.isp.get("beside", np.eye(3, 4)))
    assert responses.of("beside", 0)[:, :3] == pytest.approx(1.5 * given[:, :3])


def test_an_interruption_keeps_what_has_been_reached(street, lifted):
    def interrupt(stage, fraction):
        if stage.startswith("fitting, 40 images"):
            raise KeyboardInterrupt

    scene = method.refine(lifted, street, ["front"], set(), interrupt, OptimizeSettings(seconds=None, steps=1000))
    assert scene.provenance["refined"]["steps"] == 40
    assert mean_psnr(scene, street, "front") > mean_psnr(lifted, street, "front")


def test_an_interruption_that_is_not_to_be_kept_goes_through(street, lifted):
    def interrupt(stage, fraction):
        if stage.startswith("fitting, 2 images"):
            raise KeyboardInterrupt

    settings = OptimizeSettings(seconds=None, steps=1000, keep_interrupted=False)
    with pytest.raises(KeyboardInterrupt):
        method.refine(lifted, street, ["front"], set(), interrupt, settings)


KILLED = """
import sys
from nurec_sim import cli
from nurec_sim.reconstruct.optimize.method import Optimization

step = Optimization.step
Optimization.step = lambda *arguments: (step(*arguments), print("fitting", flush=True))[0]
cli.main(["reconstruct", sys.argv[1], "--out", "scene.usdz", "--overwrite", "--refine", "60", "--set", "sky_px=16",
          "--set", "views.levels=8", "--cameras", "front"])
"""


@pytest.mark.slow
def test_a_kill_leaves_the_old_archive(tmp_path):
    clip, archive = tiny_clip.write(tmp_path / "drive.zip"), tmp_path / "scene.usdz"
    archive.write_bytes(b"the old one")
    command = [sys.executable, "-c", KILLED, str(clip)]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as child:
        assert any("fitting" in line for line in child.stdout), "it ended before it was killed"
        child.send_signal(signal.SIGKILL)
    assert archive.read_bytes() == b"the old one"
    assert {path.name for path in tmp_path.iterdir()} <= {"drive.zip", "scene.usdz", "scene.usdz.refine.npz"}


def test_an_optimisation_resumes_exactly(street, lifted, tmp_path, monkeypatch):
    """Ctrl-C within the fourth step of eight: that step ends, and the rest gives the bytes of an uncut run."""
    whole = OptimizeSettings(seconds=None, steps=8, check_every=2)
    uncut = method.refine(lifted, street, ["front"], set(), lambda *_: None, whole)
    assert uncut.provenance["refined"]["held_out_psnr_db"] > 0
    kept = dataclasses.replace(whole, checkpoint=tmp_path / "state.npz")
    step = method.Optimization.step

    def interrupted(self, number, rate):
        if self.steps == 3:
            signal.raise_signal(signal.SIGINT)
        return step(self, number, rate)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background processes ignore it
    try:
        with monkeypatch.context() as patch:
            patch.setattr(method.Optimization, "step", interrupted)
            method.refine(lifted, street, ["front"], set(), lambda *_: None, kept)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    counts = []
    resume = dataclasses.replace(kept, resume=True)
    with pytest.raises(ReconstructError, match="belongs to another optimisation"):
        method.refine(lifted, street, ["front"], {0}, lambda *_: None, resume)
    again = method.refine(lifted, street, ["front"], set(), lambda stage, _: counts.append(stage), resume)
    assert [text.split(",")[1] for text in counts if text.startswith("fitting")] == [
        f" {k} images" for k in range(5, 9)
    ]
    assert scene_hash(again) == scene_hash(uncut)
    assert not kept.checkpoint.exists(), "the budget is spent"
    with pytest.raises(ReconstructError, match="nothing to resume"):
        method.refine(lifted, street, ["front"], set(), lambda *_: None, resume)
    kept.checkpoint.write_bytes(b"PK")
    with pytest.raises(ReconstructError, match="is not the state of an optimisation"):
        method.refine(lifted, street, ["front"], set(), lambda *_: None, resume)


def test_the_best_state_by_held_out_images_is_kept(street, lifted, monkeypatch):
    """Learning rates far too large after the first check: what was best by then is the result."""
    settings = OptimizeSettings(seconds=None, steps=20, check_every=2, final_rate=1.0)
    step = method.Optimization.step
    monkeypatch.setattr(
        method.Optimization, "step", lambda run, number, rate: step(run, number, 100.0 if run.steps > 9 else rate)
    )
    scene = method.refine(lifted, street, ["front"], set(), lambda *_: None, settings)
    assert 1 <= scene.provenance["refined"]["steps"] <= 10
    run = method.Optimization(scene, training_views(street, scene, ["front"], set()), settings)
    assert run.checked == [1, 3]
    assert np.mean([psnr(image_of(scene, street, "front", k), street.image("front", k)) for k in run.checked]) == (
        pytest.approx(scene.provenance["refined"]["held_out_psnr_db"], abs=0.1)
    )


def test_a_wrong_pose_is_corrected(street, lifted):
    views = training_views(street, lifted, ["front"], set())
    wrong = views[2].world_from_camera.copy()
    wrong[:, :3, 3] += (0.0, 0.04, 0.0)
    views[2] = dataclasses.replace(views[2], world_from_camera=wrong)
    settings = OptimizeSettings(
        seconds=None, steps=60, final_rate=0.3, rates=LearningRates(0, 0, 0, 0, 0, 0), correct_poses=True,
        poses=PosePriors(shift_m=0.05),
    )  # fmt: skip
    run = method.Optimization(lifted, views, settings)
    run.run(lambda *_: None)
    assert run.poses.of(2)[4] == pytest.approx(-0.04, abs=0.015)
    assert max(np.abs(run.poses.of(k)[4]) for k in (0, 1, 3)) < 0.02
    told = run.scene(street).provenance["refined"]["poses"]["front"]
    assert told["largest_shift_m"] > 0.02 and abs(told["time_offset_ms"]) < 2


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES)
def test_steps_on_a_gpu_are_those_on_the_cpu(street, lifted, place):
    """The kernels of the GPU in place of those of the CPU, beside the same losses and the same Adam."""
    views, drawn = training_views(street, lifted, ["front"], set())[:2], []
    # The gradient of an absolute error is a sign, which rounding decides where the scene shows what was recorded.
    off = [dataclasses.replace(view.returns, depth_m=1.02 * view.returns.depth_m) for view in views]
    views = [
        dataclasses.replace(view, returns=returns, image=np.roll(view.image, 20, axis=1))
        for view, returns in zip(views, off, strict=True)
    ]
    frames_on_gpu = GpuFrames(launcher_at(place))

    def gpu_frames(camera, pair):
        drawn.append(camera)
        return frames_on_gpu(camera, pair)

    runs = [
        method.Optimization(lifted, views, OptimizeSettings(seconds=None, steps=2, check_every=0), frames=frames)
        for frames in (cpu_frames, gpu_frames)
    ]
    losses = [run.step(0, 0.5) for run in runs]
    cpu, gpu = (run.parameters.first for run in runs)
    assert np.linalg.norm(gpu - cpu) < 0.01 * np.linalg.norm(cpu) != 0
    # Column by column, so that large gradients do not hide small ones; one of the quaternion's is not used.
    used = np.linalg.norm(cpu, axis=0) > 0
    assert used.sum() == 13
    assert (np.linalg.norm(gpu - cpu, axis=0)[used] < 0.02 * np.linalg.norm(cpu, axis=0)[used]).all()
    # The first step of Adam has the size of the rate however small the gradient: rounding turns some of them around.
    # At half the rate they move half as far apart.
    losses += [run.step(1, 0.5) for run in runs]
    assert losses[1::2] == pytest.approx(losses[::2], rel=2e-3)
    assert runs[1].psnr_db(0) == pytest.approx(runs[0].psnr_db(0), abs=0.05)
    assert len(drawn) == 3


@pytest.mark.slow
def test_the_method_is_lift_and_a_fit_and_needs_images(street):
    scene = reconstruct(street, "optimized", cameras=["front"], settings=OptimizeSettings(seconds=None, steps=1))
    assert scene.provenance["method"] == "lift" and scene.provenance["refined"]["steps"] == 1
    with pytest.raises(ReconstructError, match="needs images; have no cameras"):
        reconstruct(street, "lift", cameras=[], settings=SMALL, refine=OptimizeSettings(steps=1))
    with pytest.raises(ValueError, match="needs a budget"):
        OptimizeSettings(seconds=None)
    with pytest.raises(ValueError, match="voxel_px must be 0 or more and finite, got -1"):
        OptimizeSettings(voxel_px=-1.0)
    with pytest.raises(ValueError, match="max_gaussians must be positive and finite, got 0"):
        OptimizeSettings(max_gaussians=0)
    with pytest.raises(ValueError, match="seconds must be positive and finite, got -1"):
        OptimizeSettings(seconds=-1)


def test_view_dependent_colours_are_refused(lifted):
    sh = dataclasses.replace(lifted.static, sh_rest=np.zeros((len(lifted.static), 3, 3), np.float32))
    with pytest.raises(ReconstructError, match="view-dependent colours"):
        Parameters(dataclasses.replace(lifted, static=sh))


def test_reconstruct_keeps_the_state_beside_its_output_and_resumes_only_an_optimisation(
    street, lifted, tmp_path, monkeypatch, capsys
):
    def interrupted(log, method, *, refine, **others):
        write_checkpoint(refine.checkpoint, "key", {})
        asked.append(refine)
        return lifted

    asked = []
    monkeypatch.setattr("nurec_sim.reconstruct.reconstruct", interrupted)
    monkeypatch.setattr("nurec_sim.logs.open_clip", lambda path: street)
    monkeypatch.chdir(tmp_path)
    cli.main(["reconstruct", "street", "--refine", "60", "--out", "a.usdz"])
    assert "--resume goes on" in capsys.readouterr().out and (tmp_path / "a.usdz.refine.npz").exists()
    cli.main(["reconstruct", "street", "--refine", "60", "--out", "a.usdz", "--resume"])
    assert [each.resume for each in asked] == [False, True] and asked[0].checkpoint == Path("a.usdz.refine.npz")
    with pytest.raises(SystemExit):
        cli.main(["reconstruct", "street", "--resume"])
    assert "--resume goes on with an optimisation; give --refine" in capsys.readouterr().err


def test_the_start_holds_once_for_all_images_together(street, lifted, monkeypatch):
    """As strongly as pixels are wrong; of four images two are fitted."""
    views, taken, step = training_views(street, lifted, ["front"], set()), [], Parameters.step

    def noted(parameters, *arguments, keep, images_per_step):
        taken.append((keep, images_per_step))
        step(parameters, *arguments, keep=keep, images_per_step=images_per_step)

    monkeypatch.setattr(Parameters, "step", noted)
    settings = OptimizeSettings(
        steps=3,
        check_every=2,
        start=StartPriors(0.5, 0.25, 1e9, 0.1),
        weights=LossWeights(dssim=0, depth=0, solid=0, sky=0, surface=0),
    )
    run = method.Optimization(lifted, views, settings)
    # Without the other terms the loss is the mean absolute error.
    losses = [run.step(number, 1.0) for number in (0, 2, 0)]
    assert [images for _, images in taken] == [2 / 1, 2 / 2, 2 / 3]
    deviations = np.array([0.5] * 3 + [np.inf] * 7 + [1e9] + [0.1] * 3)
    deviations[7:10] = 0.25
    for loss, (keep, _) in zip(losses, taken, strict=True):
        assert keep == pytest.approx(loss / (128 * 64) / np.square(deviations), rel=1e-4)


@pytest.mark.parametrize(
    ("group", "wrong", "said"),
    [
        (StartPriors, {"rgb": 0}, "rgb must be above 0: it is a standard deviation"),
        (StartPriors, {"mean": float("inf")}, "mean must be 0 or more and finite, got inf"),
        (LearningRates, {"turn_rad": float("nan")}, "turn_rad must be 0 or more and finite, got nan"),
        (LossWeights, {"sky": -1}, "sky must be 0 or more and finite, got -1"),
        (OptimizeSettings, {"largest_m": float("inf")}, "largest_m must be positive and finite, got inf"),
    ],
)
def test_settings_that_an_archive_cannot_keep_or_a_fit_cannot_take_are_refused(group, wrong, said):
    with pytest.raises(ValueError, match=said):
        group(**wrong)
