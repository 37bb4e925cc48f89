"""The optimisation: one image a step, forwards and backwards through the renderer, and a step of Adam.

Per step a view is drawn with all layers at its instant; the loss compares its colours with the image (``image_loss``)
and its depth with the LiDAR returns in it (``depth_loss``); gradients go back to Gaussians, sky and the frame's
response. Only Gaussians in view take part.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.optimize.adam import SkyAdam
from nurec_sim.reconstruct.optimize.compositing import Composite
from nurec_sim.reconstruct.optimize.depth_loss import depth_loss
from nurec_sim.reconstruct.optimize.image_loss import colour_loss
from nurec_sim.reconstruct.optimize.parameters import Parameters, rate_columns
from nurec_sim.reconstruct.optimize.responses import FrameResponses, borrowed_responses
from nurec_sim.reconstruct.optimize.settings import OptimizeSettings
from nurec_sim.reconstruct.optimize.views import TrainingView, training_views
from nurec_sim.render.cpu.backward.frame import SENSORS, Frame
from nurec_sim.types import Clip, GaussianScene

Progress = Callable[[str, float], None]
SEEN_SKY = 0.05
"""Pixels with less alpha than this at the start show the sky."""


def refine(
    scene: GaussianScene,
    clip: Clip,
    cameras: Sequence[str],
    hold_out: set[int],
    progress: Progress,
    settings: OptimizeSettings,
) -> GaussianScene:
    """Fit a scene to the images of some cameras and to the sweeps of its clip.

    An interruption (KeyboardInterrupt) ends it early; what has been reached by then is the result.

    Args:
        scene: what any method made of the clip.
        clip: the log.
        cameras: whose images to fit.
        hold_out: sweeps that must not be read.
        progress: called with a stage that names the present loss, and the fraction of the budget that is spent.
        settings: budget, rates and weights.

    Raises:
        ReconstructError: no camera, no image, or view-dependent colours.
    """
    if not cameras:
        raise ReconstructError(f"clip {clip.id!r}: an optimisation needs images; have no cameras")
    progress("reading images", 0.0)
    views = training_views(clip, scene, cameras, hold_out)
    if not views:
        raise ReconstructError(f"clip {clip.id!r}: an optimisation needs images; cameras {list(cameras)} have none")
    run = Optimization(scene, views, settings)
    run.run(progress)
    return run.scene(clip)


class Optimization:
    """What changes while a scene is fitted."""

    def __init__(self, scene: GaussianScene, views: Sequence[TrainingView], settings: OptimizeSettings) -> None:
        self.settings, self.views = settings, views
        self.parameters = Parameters(scene)
        self.sky = scene.sky.astype(np.float32).copy()
        self._sky_adam = SkyAdam(self.sky)
        frames = {view.camera.id: 0 for view in views}
        for view in views:
            frames[view.camera.id] += 1
        self.responses = FrameResponses(scene.isp, frames)
        self._clear: dict[int, tuple[np.ndarray, ...]] = {}
        self.steps = 0

    def run(self, progress: Progress) -> None:
        """Spend the budget."""
        started, smooth, order = time.perf_counter(), float("nan"), self._order()
        try:
            while (spent := self._spent(time.perf_counter() - started)) < 1:
                loss = self.step(next(order), self.settings.final_rate**spent)
                smooth = loss if smooth != smooth else 0.95 * smooth + 0.05 * loss
                progress(f"fitting, {self.steps} images, loss {smooth:.4f}", spent)
        except KeyboardInterrupt:
            pass  # the caller gets what has been reached

    def step(self, number: int, rate: float) -> float:
        """Fit one view, with learning rates ``rate`` times those at the start; the loss before the step."""
        view, weights, rates = self.views[number], self.settings.weights, self.settings.rates
        height, width = view.image.shape[:2]
        frame = Frame(SENSORS.tables(view.camera), view.world_from_camera, False)
        drawn = self.parameters.at(view.t_us)
        alpha, distance = frame.draw_packed(drawn.packed)[[0, 4], :height, :width]
        composite, recorded = Composite(frame, self.sky), view.colours
        if self.responses.is_new(view.camera.id, view.frame):
            before = composite.shown(self.responses.of(view.camera.id, view.frame))
            self.responses.start(view.camera.id, view.frame, before, recorded)
        response = self.responses.of(view.camera.id, view.frame)
        shown = composite.shown(response)
        loss, by_shown = colour_loss(shown, recorded, weights.dssim)

        by_planes, by_sky, by_response = composite.back(response, shown, by_shown)
        by_alpha, by_distance = by_planes[0, :height, :width], by_planes[4, :height, :width]
        loss += depth_loss(view.returns, alpha, distance, frame.ray_z, weights.depth, weights.solid, by_alpha,
                           by_distance)  # fmt: skip
        # The sky mask is fixed at a view's first step: taken anew, it would follow what it is meant to hold.
        if number not in self._clear:
            self._clear[number] = np.nonzero(alpha < SEEN_SKY)
        sky = self._clear[number]
        if len(sky[0]):
            by_alpha[sky] += weights.sky / len(sky[0])
            loss += weights.sky * float(alpha[sky].mean())

        world = drawn.world
        frame.draw_back(world.mean, world.quat, world.scale, world.opacity, by_planes, self.parameters.gradients)
        columns = rate * rate_columns(rates.mean_m, rates.quat, rates.log_scale, rates.logit_opacity, rates.rgb)
        self.parameters.step(drawn, frame.drawn_rows, columns, self.settings.largest_m)
        self._sky_adam.step(self.sky, by_sky, rate * rates.sky)
        self.responses.step(view.camera.id, view.frame, by_response, rate * rates.response, weights.response)
        self.steps += 1
        return loss

    def scene(self, clip: Clip) -> GaussianScene:
        """The scene as it is now."""
        fitted = self.parameters.scene()
        times = {name: clip.camera_times_us(name) for name in clip.rig.cameras}
        exposures = self.responses.all()
        others = [name for name in clip.rig.cameras if name not in exposures]
        exposures |= borrowed_responses(exposures, times, clip.rig, others)
        done = {
            "settings": dataclasses.asdict(self.settings),
            "cameras": sorted({view.camera.id for view in self.views}),
            "steps": self.steps,
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
        random = np.random.default_rng(self.settings.seed)
        while True:
            # Without replacement: every view counts once per round.
            yield from random.permutation(len(self.views)).tolist()
