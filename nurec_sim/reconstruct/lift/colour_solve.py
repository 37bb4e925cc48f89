"""Colours solved for: those with which the finished Gaussians reproduce the images best.

With geometry and opacities fixed, a rendered colour is linear in the colours of Gaussians, so the best colours are a
least-squares problem, solved by the simultaneous algebraic reconstruction technique (Andersen and Kak 1984), image
by image: a colour changes by the mean error of the pixels that it takes part in, weighted by its shares of them. The
step falls with the pixels that have been taken, so that every image counts alike. Beside it every frame gets a gain and
an offset per channel, because exposure changes from frame to frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from nurec_sim import sensors
from nurec_sim.compute.cores import in_order, usable_cores
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.colour import SATURATED
from nurec_sim.reconstruct.lift.image_errors import BYTE, LEAST_CLEAR, image_errors
from nurec_sim.reconstruct.lift.settings import LiftSettings, ViewSettings
from nurec_sim.reconstruct.lift.shade import Shades, add_shaded, find_shaded
from nurec_sim.reconstruct.lift.shadows import with_shadows
from nurec_sim.reconstruct.lift.views import LEAST_SKY_WEIGHT, border_weight
from nurec_sim.reconstruct.optimize.responses import borrowed_responses
from nurec_sim.render.cpu.backward.colours import spread_errors, spread_sky_errors
from nurec_sim.render.cpu.backward.frame import SENSORS, ExactView
from nurec_sim.render.cpu.blend.background import draw_sky
from nurec_sim.render.cpu.blend.responses import CAMERA
from nurec_sim.render.cpu.blend.tiles import AFFINE
from nurec_sim.render.cpu.moving import PackedMoving
from nurec_sim.render.cpu.pack import BLOCK, COLOUR, pack
from nurec_sim.render.cpu.pipeline import NO_TABLE, Picture, blocks_in_view, draw
from nurec_sim.render.cpu.workers import Buffers, Workers
from nurec_sim.types import CameraModel, Clip, Gaussians, GaussianScene

GAINS, OFFSETS = (0.5, 2.0), (-0.1, 0.1)
BRIGHTEST = 1 / GAINS[0]
"""Colours end here: what is white in the darkest frame, so that many times brighter than white in others."""
OFFSET_PULL = 20.0
"""Offsets are pulled to 0 this much more than gains to 1: fog and glare are rarer than other exposures."""
FIT_PX = 3
"""A frame's response is fitted to every so many pixels in each direction."""


@dataclass(frozen=True, eq=False)
class SolvedImage:
    """A frame at working size: its camera with fewer pixels, its poses, its colours, and what its pixels count."""

    camera: CameraModel
    frame: int
    t_us: int
    world_from_camera: Float64[np.ndarray, "2 4 4"]
    rgb: UInt8[np.ndarray, "h w 3"]
    weights: Float32[np.ndarray, "2 h w"]
    """Of each pixel, in the colours of Gaussians and in those of the sky."""


class Solved(NamedTuple):
    """A scene with solved colours."""

    scene: GaussianScene
    pixels: Float32[np.ndarray, " n"] | None
    """Shares of each static Gaussian of all pixels of the images, added up; None: nothing was solved for."""


def solve_colours(
    scene: GaussianScene, clip: Clip, cameras: Sequence[str], settings: LiftSettings, progress: Callable[[float], None]
) -> Solved:
    """The scene with the colours, sky and responses that fit the images best.

    Args:
        scene: with geometry, opacities and first colours.
        clip: its log.
        cameras: whose images to fit.
        settings: ``colours``, and the width of working views.
        progress: called with the fraction that is done.
    """
    times = {camera: np.asarray(clip.camera_times_us(camera), np.int64) for camera in clip.rig.cameras}
    frames = [(camera, k) for camera in cameras for k in range(len(times[camera]))]
    if not frames or not settings.colours.rounds:
        return Solved(scene, None)
    step = -(-len(frames) // settings.colours.images)
    chosen = [(camera, k) for camera in cameras for k in range(0, len(times[camera]), step)]
    # In random order: of neighbours in time, which show the same, the later would correct the earlier.
    random, rounds = np.random.default_rng(0), settings.colours.images // len(chosen)
    order = [random.permutation(len(chosen)) for _ in range(min(max(rounds, 1), settings.colours.rounds))]
    images = [chosen[k] for k in np.concatenate(order)]
    taken = [(model.width_px, model.height_px, sum(name == camera for name, _ in images))
             for camera, model in clip.rig.cameras.items() if camera in cameras]  # fmt: skip
    views = replace(settings.views, pixels=settings.colours.pixels, max_frames=len(images)).widened(taken)
    weights = {camera: _pixel_weights(scene, camera, views, len(cameras) > 1) for camera in cameras}
    solve = ColourSolve(scene, settings.colours.trust, settings.colours.gain_pull)
    for done, image in enumerate(in_order(lambda each: _read(clip, each[0], each[1], weights[each[0]]), images)):
        solve.step(image)
        progress((done + 1) / len(images))
    middle = {camera: each.sum(axis=1) // 2 for camera, each in times.items()}
    responses = {}
    for camera in dict.fromkeys(camera for camera, _ in chosen):
        known = [k for name, k in chosen if name == camera]
        flat = np.array([solve.responses[camera, k] for k in known]).reshape(len(known), 12)
        columns = [np.interp(middle[camera], middle[camera][known], flat[:, c]) for c in range(12)]
        responses[camera] = np.stack(columns, axis=1).reshape(-1, 3, 4)
    others = [camera for camera in clip.rig.cameras if camera not in responses]
    responses |= borrowed_responses(responses, times, clip.rig, others)
    solved = with_shadows(replace(solve.scene(), exposures=responses), solve.shades)
    return Solved(solved, solve.pixels() / len(order))


def _pixel_weights(
    scene: GaussianScene, camera: str, views: ViewSettings, several: bool
) -> Float32[np.ndarray, "2 h w"]:
    """Weights of the pixels of a camera, at the size of its working views; see ``SolvedImage``.

    Pixels of the ego vehicle and past the lens count nothing. Among several cameras those near the border count less,
    and in the sky pixels count by their solid angle in texels: a longer lens would else outvote the others there.
    """
    model = scene.rig.cameras[camera]
    reduction = views.reduction_of(model.width_px)
    width, height = model.width_px // reduction, model.height_px // reduction
    rays, seen = sensors.pixel_rays(sensors.scaled_camera(model, width, height))
    street = seen.astype(np.float32)
    if (image := scene.ego_images.get(camera)) is not None:
        cover = cv2.resize(image[..., 3].astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        street[cover > 0] = 0
    if not several:
        return np.stack([street, street])
    texels = _middle_solid_angle(rays) / (4 * np.pi / scene.sky[..., 0].size)
    return np.stack(
        [street * border_weight(height, width), street * border_weight(height, width, LEAST_SKY_WEIGHT) * texels]
    ).astype(np.float32)


def _middle_solid_angle(rays: Float64[np.ndarray, "h w 3"]) -> float:
    """Solid angle of the pixel in the middle, in steradian."""
    v, u = (n // 2 for n in rays.shape[:2])
    across, down = rays[v, u] - rays[v, u - 1], rays[v, u] - rays[v - 1, u]
    return float(np.linalg.norm(np.cross(across, down)))


def _read(clip: Clip, camera: str, frame: int, weights: Float32[np.ndarray, "2 h w"]) -> SolvedImage:
    """A frame, reduced to the size of its weights by a whole number, as working views are."""
    model, image = clip.rig.cameras[camera], clip.image(camera, frame)
    height, width = weights.shape[1:]
    reduction = model.width_px // width
    small = cv2.resize(image[: height * reduction, : width * reduction], (width, height), interpolation=cv2.INTER_AREA)
    t_us = int(np.asarray(clip.camera_times_us(camera)[frame]).sum()) // 2
    poses = np.asarray(clip.world_from_camera(camera, frame), np.float64)
    return SolvedImage(sensors.scaled_camera(model, width, height), frame, t_us, poses, small, weights)


class ColourSolve:
    """The colours of a scene while they are solved for.

    Args:
        scene: what has been built.
        trust: how many pixels the colours that it comes with count for.
        gain_pull: see ``ColourSettings``.
    """

    def __init__(self, scene: GaussianScene, trust: float, gain_pull: float) -> None:
        self._scene, self._gain_pull, self.shades = scene, gain_pull, Shades(scene.tracks)
        self._static, self._moving = pack(scene.static), PackedMoving.of(scene.dynamic, scene.tracks)
        self._sky = np.array(scene.sky, np.float32)
        shapes = ((len(self._static), BLOCK), (len(self._moving), BLOCK), self._sky.shape[:3])
        self._trust = np.float32(trust)
        self._seen = [np.full(shape, trust, np.float32) for shape in shapes]
        self._workers, self._buffers = Workers(usable_cores()), Buffers()
        self._beside = ThreadPoolExecutor(1)
        self.responses: dict[tuple[str, int], np.ndarray] = {}
        """By camera and frame, [3,4]."""

    def step(self, image: SolvedImage) -> None:
        """Take the errors of an image back to the colours."""
        with self._buffers.lend() as scratch:
            sensor = SENSORS.tables(image.camera)
            view = ExactView.of(sensor.grid, image.world_from_camera)
            eye, turn = view.world_from_reference[:3, 3], view.world_from_reference[:3, :3]
            moving = self._moving.at(image.t_us, {}, frozenset(), eye, self._workers, scratch)
            layers = [(layer, blocks_in_view(view, layer)) for layer in (self._static, moving)]
            rays = NO_TABLE if view.projection_mode == AFFINE else sensor.rays
            picture = Picture(view, rays, CAMERA, layers, scratch)
            planes = draw([picture], self._workers)[0]
            height, width = image.rgb.shape[:2]
            clear = 1 - planes[0, :height, :width]
            clear[clear < LEAST_CLEAR] = 0
            behind = draw_sky(view.directions, turn, self._sky, self._workers, clear)
            response = self._fit_response(image, planes, clear, behind, sensor.grid.valid)
            error, weight, sky_weight = np.empty_like(behind), np.empty_like(clear), np.empty_like(clear)
            rows, valid = self._workers.ranges(height, 16), sensor.grid.valid
            back = np.linalg.inv(response[:, :3]), response[:, 3].copy()
            pixels = (image.rgb, *back, planes, clear, behind, image.weights, valid, error, weight, sky_weight)
            self._workers.run(image_errors, [(*part, *pixels) for part in rows])
            if len(boxes := self.shades.boxes(image.t_us)):
                cell, shade = np.empty(weight.shape, np.int32), np.empty((4, *weight.shape), np.float32)
                sums = self.shades.sums
                ground = (view.directions, turn, eye, planes, clear, behind, boxes, sums, weight, error, cell, shade)
                self._workers.run(find_shaded, [(*part, *ground) for part in rows])
                add_shaded(cell, shade, sums)
            texels = np.zeros((*self._sky.shape[:3], 4), np.float32)
            sky = self._beside.submit(spread_sky_errors, view.directions, turn, sky_weight, error, texels)
            shares = spread_errors(picture, planes, weight, error, self._workers)
            sky.result()
            # Placed blocks of the moving layer follow each other as those they were made from.
            placed = np.flatnonzero(np.isin(self._moving.index[:, 0], moving.index.reshape(-1, BLOCK)[:, 0]))
            changes = [(layers[0][1], layers[0][1], shares[0], self._seen[0], self._static.fields),
                       (layers[1][1], placed[layers[1][1]], shares[1], self._seen[1], self._moving.fields)]  # fmt: skip
            self._workers.run_calls([
                *((_change_blocks, drawn[low:high], blocks[low:high], *values) for drawn, blocks, *values in changes
                  for low, high in self._workers.ranges(len(blocks), 16)),
                *((_change_sky, *face) for face in zip(texels, self._seen[2], self._sky, strict=True)),
            ])  # fmt: skip

    def _fit_response(
        self,
        image: SolvedImage,
        planes: Float32[np.ndarray, "6 y x"],
        clear: Float32[np.ndarray, "h w"],
        behind: Float32[np.ndarray, "3 h w"],
        valid: Float32[np.ndarray, "h w"],
    ) -> Float64[np.ndarray, "3 4"]:
        """The frame's response: its camera's, then a gain and an offset per channel, by robust least squares."""
        isp = np.asarray(self._scene.isp.get(image.camera.id, np.eye(3, 4)), np.float64)
        height, width = clear.shape
        some = (slice(0, height, FIT_PX), slice(0, width, FIT_PX))
        shown = (planes[1:4, *some] + clear[some] * behind[:, *some]).reshape(3, -1)
        x = np.einsum("ij,jn->in", isp[:, :3], shown) + isp[:, 3:]
        y = (image.rgb[some].reshape(-1, 3).T.astype(np.float32) / BYTE).astype(np.float64)
        counts = (image.weights[0][some] * (valid[some] > 0)).ravel() * (y < SATURATED)
        response = isp.copy()
        for c in range(3):
            gain, offset, pull = 1.0, 0.0, self._gain_pull * counts[c].sum() + 1e-9
            for _ in range(4):
                # Cauchy weights (iteratively reweighted): what is wrong in the scene must not change the exposure.
                w = counts[c] / (1 + ((y[c] - gain * x[c] - offset) / 0.1) ** 2)
                # Normal equations of w (y - gain x - offset)^2 + pull (gain - 1)^2 + OFFSET_PULL pull offset^2.
                across = (w * x[c]).sum()
                left = [[(w * x[c] ** 2).sum() + pull, across], [across, w.sum() + OFFSET_PULL * pull]]
                gain, offset = np.linalg.solve(left, [(w * x[c] * y[c]).sum() + pull, (w * y[c]).sum()])
            gain, offset = np.clip(gain, *GAINS), np.clip(offset, *OFFSETS)
            response[c] = gain * isp[c]
            response[c, 3] += offset
        self.responses[image.camera.id, image.frame] = response
        return response

    def pixels(self) -> Float32[np.ndarray, " n"]:
        """Shares of each static Gaussian of the pixels so far, added up."""
        index = self._static.index
        pixels = np.zeros(len(self._scene.static), np.float32)
        pixels[index[index >= 0]] = self._seen[0].ravel()[index >= 0] - self._trust
        return pixels

    def scene(self) -> GaussianScene:
        """The scene with the present colours."""
        scene, dynamic = self._scene, self._scene.dynamic
        static = _with_colours(scene.static, self._static.fields, self._static.index)
        moving = _with_colours(dynamic.gaussians, self._moving.fields, self._moving.index.reshape(-1))
        return replace(scene, static=static, dynamic=replace(dynamic, gaussians=moving), sky=self._sky.copy())


@kernel
def _change_blocks(drawn, blocks, shares, seen, fields):
    """Change colours by the errors of one image.

    Args:
        drawn: [b] numbers of the blocks that have been drawn, by which ``shares`` are numbered.
        blocks: [b] the same blocks, by which ``seen`` and ``fields`` are numbered.
        shares: [rows,4] see ``spread_errors``.
        seen: [blocks,256] pixels that each Gaussian has been changed by; changed.
        fields: [blocks,21,256] see ``pack``; the colours are changed.
    """
    for n in range(len(blocks)):
        block = blocks[n]
        for i in range(BLOCK):
            share = shares[drawn[n] * BLOCK + i]
            if share[0] > 0:
                seen[block, i] += share[0]
                for c in range(3):
                    colour = fields[block, COLOUR + c, i] + share[1 + c] / seen[block, i]
                    fields[block, COLOUR + c, i] = min(max(colour, np.float32(0)), np.float32(BRIGHTEST))


@kernel
def _change_sky(shares, seen, sky):
    """The same for the texels of a face of the sky: [s,s,4], [s,s] and [s,s,3]."""
    for j in range(sky.shape[0]):
        for i in range(sky.shape[1]):
            share = shares[j, i]
            if share[0] > 0:
                seen[j, i] += share[0]
                for c in range(3):
                    colour = sky[j, i, c] + share[1 + c] / seen[j, i]
                    sky[j, i, c] = min(max(colour, np.float32(0)), np.float32(BRIGHTEST))


def _with_colours(gaussians: Gaussians, fields: np.ndarray, index: np.ndarray) -> Gaussians:
    """Gaussians with the colours of packed ones."""
    rgb = gaussians.rgb.copy()
    rgb[index[index >= 0]] = fields[:, COLOUR : COLOUR + 3].transpose(0, 2, 1).reshape(-1, 3)[index >= 0]
    return replace(gaussians, rgb=rgb)
