"""The optimisation: one image a step, forwards and backwards through the renderer, and a step of Adam.

Per step a view is drawn with all layers at its instant; the loss compares its colours with the image (``image_loss``)
and its depth with the LiDAR returns in it (``depth_loss``); gradients go back to Gaussians, sky and the frame's
response. Only Gaussians in view take part. What a fit brings into free space is taken out now and then (``free``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.free_space import SweepBeams
from nurec_sim.reconstruct.optimize.adam import SkyAdam
from nurec_sim.reconstruct.optimize.checkpoint import read_checkpoint, write_checkpoint
from nurec_sim.reconstruct.optimize.compositing import Composite
from nurec_sim.reconstruct.optimize.coverage import Coverage, coverage_loss
from nurec_sim.reconstruct.optimize.depth_loss import depth_loss
from nurec_sim.reconstruct.optimize.frames import Frames, cpu_frames, frames_on
from nurec_sim.reconstruct.optimize.free import CLEARINGS, recorded_beams, take_out
from nurec_sim.reconstruct.optimize.image_loss import colour_loss
from nurec_sim.reconstruct.optimize.interruption import whole_steps
from nurec_sim.reconstruct.optimize.merged import merged
from nurec_sim.reconstruct.optimize.parameters import Drawn, Parameters, per_value
from nurec_sim.reconstruct.optimize.poses import PoseCorrections
from nurec_sim.reconstruct.optimize.responses import FrameResponses, borrowed_responses
from nurec_sim.reconstruct.optimize.settings import OptimizeSettings
from nurec_sim.reconstruct.optimize.tracks import TrackCorrections
from nurec_sim.reconstruct.optimize.unseen import colour_hardly_shown, pixel_shares
from nurec_sim.reconstruct.optimize.views import TrainingView, training_views
from nurec_sim.render.device import choose_device
from nurec_sim.scene import scene_hash
from nurec_sim.types import Clip, GaussianScene

Progress = Callable[[str, float], None]
CHECK_SHARE = 0.05
"""The images held out are looked at once in this share of the budget."""
WARM_UP_STEPS = 20
"""Learning rates rise to their full size over so many steps."""


def refine(
    scene: GaussianScene,
    clip: Clip,
    cameras: Sequence[str],
    hold_out: set[int],
    progress: Progress,
    settings: OptimizeSettings,
) -> GaussianScene:
    """Fit a scene to the images of some cameras and to the sweeps of its clip.

    Ctrl-C ends it early, after the present step; the best state by then is the result.

    Args:
        scene: what any method made of the clip.
        clip: the log.
        cameras: whose images to fit.
        hold_out: sweeps that must not be read.
        progress: called with a stage that names the present loss, and the fraction of the budget that is spent.
        settings: budget, rates and weights.

    Raises:
        ReconstructError: no camera, no image, view-dependent colours, or fewer Gaussians allowed than there are labels.
        GpuError: ``settings.device`` cannot be used.
    """
    settings = dataclasses.replace(settings, device=choose_device(settings.device).name)
    if not cameras:
        raise ReconstructError(f"clip {clip.id!r}: an optimisation needs images; have no cameras")
    scene = merged(scene, [clip.rig.cameras[name] for name in cameras], settings.voxel_px, settings.max_gaussians)
    progress("reading images", 0.0)
    views = training_views(clip, scene, cameras, hold_out)
    if not views:
        raise ReconstructError(f"clip {clip.id!r}: an optimisation needs images; cameras {list(cameras)} have none")
    run = Optimization(scene, views, settings, recorded_beams(clip, hold_out), frames_on(settings.device))
    if settings.checkpoint is not None:
        run.key = _key(scene, cameras, hold_out, settings)
        if settings.resume:
            run.restore(read_checkpoint(settings.checkpoint, run.key))
    run.run(progress)
    progress("colours of what images hardly show", 1.0)
    run.colour_hardly_shown()
    return run.scene(clip)


def _key(scene: GaussianScene, cameras: Sequence[str], hold_out: set[int], settings: OptimizeSettings) -> str:
    """What a checkpoint must have in common with the optimisation that resumes it: all but the budget."""
    same = dataclasses.replace(
        settings, seconds=None, steps=1, checkpoint=None, checkpoint_s=0.0, resume=False, keep_interrupted=True
    )
    text = f"{scene_hash(scene)} {list(cameras)} {sorted(hold_out)} {same}"
    return hashlib.sha256(text.encode()).hexdigest()


class Optimization:
    """What changes while a scene is fitted.

    Args:
        scene: as it is at the start.
        views: the images to fit.
        settings: budget, rates and weights.
        beams: recorded beams, by which free space is known.
        frames: where images are drawn.
    """

    def __init__(
        self,
        scene: GaussianScene,
        views: Sequence[TrainingView],
        settings: OptimizeSettings,
        beams: Sequence[SweepBeams] = (),
        frames: Frames = cpu_frames,
    ) -> None:
        self.settings, self.views, self.beams, self.key = settings, views, beams, ""
        self._frame = frames
        self.parameters = Parameters(scene)
        self.sky = scene.sky.astype(np.float32).copy()
        self._sky_adam = SkyAdam(self.sky)
        counts = Counter(view.camera.id for view in views)
        self.poses = PoseCorrections(views, settings.poses)
        self.tracks = TrackCorrections(scene, settings.tracks)
        self.responses = FrameResponses(scene, counts)
        every = settings.check_every
        self.checked = [
            number for number, view in enumerate(views)
            if every and counts[view.camera.id] >= 2 * every and view.frame % every == every // 2
        ]  # fmt: skip
        self._coverage = Coverage()
        self.steps, self._seconds_before, self._cleared = 0, 0.0, 0
        self.best: dict[str, np.ndarray] = {}
        self.best_psnr_db, self.best_steps = -np.inf, 0

    def run(self, progress: Progress) -> None:
        """Spend the budget; end with the best state."""
        started, smooth, order = time.perf_counter(), float("nan"), self._order()
        saved, checked, file = started, self._spent(self._seconds_before), self.settings.checkpoint
        keep = self.settings.keep_interrupted
        whole: contextlib.AbstractContextManager[list[int]] = whole_steps() if keep else contextlib.nullcontext([])
        with whole as interrupted, contextlib.suppress(*[KeyboardInterrupt] * keep):
            while (spent := self._spent(seconds := self._seconds_before + time.perf_counter() - started)) < 1:
                if spent >= (self._cleared + 1) / CLEARINGS:
                    self._clear_free_space()
                if spent >= checked + CHECK_SHARE:
                    checked = spent
                    self._check()
                if file is not None and (interrupted or time.perf_counter() - saved > self.settings.checkpoint_s):
                    write_checkpoint(file, self.key, self.state(seconds))
                    saved = time.perf_counter()
                if interrupted:
                    break
                # Adam's first steps are of full size however small the gradient: they would undo what was solved for.
                warmth = min(1.0, (self.steps + 1) / WARM_UP_STEPS)
                loss = self.step(next(order), warmth * self.settings.final_rate**spent)
                smooth = loss if smooth != smooth else 0.95 * smooth + 0.05 * loss
                progress(f"fitting, {self._text(smooth)}", spent)
        if file is not None and not interrupted:
            file.unlink(missing_ok=True)
        self._check()
        self._restore(self.best)
        self._clear_free_space()

    def colour_hardly_shown(self) -> None:
        """Give what images hardly show the colours of what is like it."""
        colour_hardly_shown(self.parameters, pixel_shares(self.parameters, self.views))
        if self.best:
            self.best_psnr_db = self._checked_psnr_db()

    def _clear_free_space(self) -> None:
        """Take out what recorded beams have passed through."""
        self._cleared += 1
        take_out(self.parameters, self.beams)

    def _text(self, loss: float) -> str:
        known = f", best {self.best_psnr_db:.2f} dB" if self.best else ""
        return f"{self.steps} images, loss {loss:.4f}{known}, {len(self.parameters) / 1e6:.2f} M Gaussians"

    def _check(self) -> None:
        """Keep the state if it shows the images that are held out better than all before."""
        if not self.checked:
            return
        psnr_db = self._checked_psnr_db()
        if psnr_db > self.best_psnr_db:
            self.best_psnr_db, self.best_steps = psnr_db, self.steps
            self.best = {name: array.copy() for name, array in self._result().items()}

    def _checked_psnr_db(self) -> float:
        """How well the images that are held out are shown."""
        return float(np.mean([self.psnr_db(number) for number in self.checked]))

    def psnr_db(self, number: int) -> float:
        """How well an image is shown."""
        view = self.views[number]
        frame = self._frame(view.camera, self.poses.pair(number))
        frame.draw_packed(self.parameters.at(view.t_us, self.tracks.pose).packed)
        shown = Composite(frame, self.sky).shown(self.responses.of(view.camera.id, view.frame))
        shown = np.clip(shown, 0, 1)
        error = np.square(shown - view.colours_beside(shown)).mean(dtype=np.float64)
        return -10 * float(np.log10(max(error, 1e-12)))

    def _result(self) -> dict[str, np.ndarray]:
        """The arrays that make the scene, as they are kept."""
        found = {"values": self.parameters.values, "sky": self.sky, "poses": self.poses.values,
                 "offsets": self.poses.offsets, "tracks": self.tracks.values}  # fmt: skip
        return found | {f"response {name}": values for name, values in self.responses.values.items()}

    def _moments(self) -> dict[str, np.ndarray]:
        """The arrays of all Adams, as they are kept."""
        adams = {"gaussians": self.parameters, "sky": self._sky_adam, "poses": self.poses.adam,
                 "offsets": self.poses.offset_adam, "tracks": self.tracks.adam}  # fmt: skip
        adams |= {f"response {name}": adam for name, adam in self.responses.adam.items()}
        return {f"{part} of {name}": getattr(adam, part) for name, adam in adams.items()
                for part in ("first", "second", "visits")}  # fmt: skip

    def state(self, seconds: float) -> dict[str, np.ndarray]:
        """Everything that a later run needs to go on exactly; ``seconds`` have been spent."""
        numbers = np.array([self.steps, seconds, self.best_steps, self.best_psnr_db, self._cleared])
        best = {f"best {name}": array for name, array in self.best.items()}
        return self._result() | self._moments() | best | self._coverage.state() | {"numbers": numbers}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a state."""
        steps, self._seconds_before, best_steps, self.best_psnr_db, cleared = state["numbers"].tolist()
        self.steps, self.best_steps, self._cleared = int(steps), int(best_steps), int(cleared)
        self.best = {name.removeprefix("best "): a for name, a in state.items() if name.startswith("best ")}
        self._coverage.restore(state)
        self._restore({name: state[name] for name in self._result() | self._moments()})

    def _restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, array in (self._result() | self._moments()).items():
            if name in arrays:
                array[...] = arrays[name]
        if "values" in arrays:
            self.parameters.values_changed()

    def step(self, number: int, rate: float) -> float:
        """Fit one view, with learning rates ``rate`` times those at the start; the loss before the step."""
        view, weights, rates = self.views[number], self.settings.weights, self.settings.rates
        height, width = view.image.shape[:2]
        frame = self._frame(view.camera, self.poses.pair(number))
        drawn = self.parameters.at(view.t_us, self.tracks.pose)
        alpha, distance = frame.draw_packed(drawn.packed)[[0, 4], :height, :width]
        composite = Composite(frame, self.sky)
        if self.responses.is_new(view.camera.id, view.frame):
            before = composite.shown(self.responses.of(view.camera.id, view.frame))
            self.responses.start(view.camera.id, view.frame, before, view.colours_beside(before))
        response = self.responses.of(view.camera.id, view.frame)
        shown = composite.shown(response)
        recorded = view.colours_beside(shown)
        loss, by_shown = colour_loss(shown, recorded, weights.dssim)
        error = float(np.abs(shown - recorded).mean(dtype=np.float64))

        sky, surface = self._coverage.of(number, alpha, frame.sensor.grid.valid)
        by_planes, by_sky, by_pose, by_response = composite.back(response, shown, by_shown, sky)
        by_alpha, by_distance = by_planes[0, :height, :width], by_planes[4, :height, :width]
        loss += depth_loss(view.returns, alpha, distance, frame.ray_z, weights.depth, weights.solid, by_alpha,
                           by_distance)  # fmt: skip
        loss += coverage_loss(alpha, sky, surface, weights, by_alpha)

        world = drawn.world
        *_, by_pose_too = frame.draw_back(
            world.mean, world.quat, world.scale, world.opacity, by_planes, self.parameters.gradients
        )
        if self.settings.correct_poses:
            self.poses.step(number, frame.view.world_from_reference, by_pose + by_pose_too, rate)
        if self.settings.correct_tracks:
            self.tracks.step(view.t_us, drawn.poses, self.parameters.wrenches(drawn, frame.drawn_rows), rate)
        self._step_gaussians(drawn, frame.drawn_rows, error / (height * width), rate)
        self._sky_adam.step(self.sky, by_sky, rate * rates.sky)
        self.responses.step(view.camera.id, view.frame, by_response, rate * rates.response, weights.response)
        self.steps += 1
        return loss

    def _step_gaussians(self, drawn: Drawn, rows: np.ndarray, pixel_error: float, rate: float) -> None:
        """Adam on the Gaussians that an image shows; its mean absolute error is ``pixel_error`` times its pixels.

        Errors of pixels are like |e| / b (Laplace), with b their mean. A prior d^2 / (2 s^2), once per Gaussian, beside
        the sum of |e| / b over all images is b d^2 / (2 s^2) / pixels beside the means of |e| that are the loss.
        """
        settings, rates, start = self.settings, self.settings.rates, self.settings.start
        by_value = per_value(rates.mean, rates.turn_rad, rates.log_scale, rates.logit_opacity, rates.rgb)
        deviation = per_value(start.mean, np.inf, start.log_scale, start.logit_opacity, start.rgb)
        self.parameters.step(
            drawn, rows, rate * by_value, settings.largest_m, settings.weights.opacity, settings.weights.scale,
            keep=pixel_error / np.square(deviation),
            images_per_step=(len(self.views) - len(self.checked)) / (self.steps + 1),
        )  # fmt: skip

    def scene(self, clip: Clip) -> GaussianScene:
        """The scene as it is now."""
        fitted = self.tracks.applied(self.parameters.scene())
        times = {name: clip.camera_times_us(name) for name in clip.rig.cameras}
        exposures = self.responses.all()
        others = [name for name in clip.rig.cameras if name not in exposures]
        exposures |= borrowed_responses(exposures, times, clip.rig, others)
        done = {
            "settings": {
                name: value
                for name, value in dataclasses.asdict(self.settings).items()
                if name not in ("checkpoint", "checkpoint_s", "resume", "keep_interrupted")
            },
            "cameras": sorted({view.camera.id for view in self.views}),
            "steps": self.best_steps if self.best else self.steps,
            **({"held_out_psnr_db": round(self.best_psnr_db, 3)} if self.best else {}),
            **({"poses": self.poses.report()} if self.settings.correct_poses else {}),
            **({"tracks": self.tracks.report()} if self.settings.correct_tracks else {}),
            "borrowed_responses": [name for name in others if name in exposures],
        }
        return dataclasses.replace(
            fitted, sky=self.sky.copy(), exposures=exposures, provenance={**fitted.provenance, "refined": done}
        )

    def _spent(self, seconds: float) -> float:
        """Share of the budget that is spent."""
        by_time = 0.0 if self.settings.seconds is None else seconds / self.settings.seconds
        by_steps = 0.0 if self.settings.steps is None else self.steps / self.settings.steps
        return max(by_time, by_steps)

    def _order(self) -> Iterator[int]:
        """Numbers of views: every one once, in random order, again and again."""
        fitted = np.setdiff1d(np.arange(len(self.views)), self.checked)
        random = np.random.default_rng(self.settings.seed)
        # Without replacement: every view counts once per round. What was fitted before is passed over.
        rounds = (number for _ in itertools.count() for number in random.permutation(fitted).tolist())
        return itertools.islice(rounds, self.steps, None)
