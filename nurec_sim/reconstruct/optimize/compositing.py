"""Kernels between the rendered planes and the image a camera shows: sky, response, and back."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim.compute.kernels import kernel
from nurec_sim.render.cpu.backward.frame import Frame, shared_workers

PARTS = 8
"""Bands of an image whose sums are added up; a fixed number, so that threads do not change the sum."""
OPAQUE = 1 / 512
"""A pixel that lets less through shows no sky: half a step of 8 bits at most."""


class Composite:
    """The image of a frame: Gaussians over the sky, as its camera shows it, and the way back.

    Args:
        frame: the frame; it has drawn its Gaussians.
        sky: [6,s,s,3] cubemap.
    """

    def __init__(self, frame: Frame, sky: Float32[np.ndarray, "6 s s 3"]) -> None:
        self._frame, self._sky = frame, sky
        self._valid = frame.sensor.grid.valid
        self._bands = [
            tuple(rows)
            for rows in np.linspace(0, len(self._valid), PARTS + 1).astype(int).repeat(2)[1:-1].reshape(-1, 2)
        ]
        self.clear = np.empty(self._valid.shape, np.float32)
        shared_workers(None).run(_let_through, [(*rows, frame.planes, self._valid, self.clear) for rows in self._bands])
        self._behind = frame.draw_sky(sky, self.clear)

    def shown(self, response: Float64[np.ndarray, "3 4"]) -> Float32[np.ndarray, "h w 3"]:
        """The image after a camera's response; pixels without a ray are black."""
        image = np.empty((*self._valid.shape, 3), np.float32)
        values = (self._frame.planes, self._valid, self.clear, self._behind, response.astype(np.float32), image)
        shared_workers(None).run(_show, [(*rows, *values) for rows in self._bands])
        return image

    def back(
        self,
        response: Float64[np.ndarray, "3 4"],
        shown: Float32[np.ndarray, "h w 3"],
        by_shown: Float32[np.ndarray, "h w 3"],
        sky: Bool[np.ndarray, "h w"],
    ) -> tuple[
        Float32[np.ndarray, "6 h w"], Float64[np.ndarray, "6 s s 3"], Float64[np.ndarray, "4 4"],
        Float64[np.ndarray, "2 3"],
    ]:  # fmt: skip
        """Gradients by the frame's planes, and by the sky and the pose it is seen from; sums for the response.

        Only pixels that show the ``sky`` change it: what is wrong with a surface that lets a little of the sky through
        would be painted on the sky behind. The sums over all pixels, by channel, are those of ``by_shown * shown`` and
        of ``by_shown``.
        """
        by_planes, by_behind = self._frame.empty_planes(), np.empty((3, *self._valid.shape), np.float32)
        sums = np.zeros((PARTS, 2, 3))
        values = (
            self._valid,
            self.clear,
            self._behind,
            response.astype(np.float32),
            shown,
            by_shown,
            by_planes,
            by_behind,
        )
        shared_workers(None).run(_take_back, [(*rows, *values, sums[k]) for k, rows in enumerate(self._bands)])
        by_behind[:, ~sky] = 0
        return by_planes, *self._frame.draw_sky_back(self._sky, by_behind), sums.sum(axis=0)


@kernel
def _let_through(first, last, planes, valid, clear):
    """1 - alpha of every pixel, 0 where that is next to nothing."""
    for v in range(first, last):
        for u in range(valid.shape[1]):
            through = np.float32(1) - planes[0, v, u]
            clear[v, u] = through if valid[v, u] > 0 and through > OPAQUE else np.float32(0)


@kernel
def _show(first, last, planes, valid, clear, behind, response, image):
    """Shown = R (c + clear sky) + b."""
    for v in range(first, last):
        for u in range(valid.shape[1]):
            x = planes[1, v, u] + clear[v, u] * behind[0, v, u]
            y = planes[2, v, u] + clear[v, u] * behind[1, v, u]
            z = planes[3, v, u] + clear[v, u] * behind[2, v, u]
            for c in range(3):
                value = response[c, 0] * x + response[c, 1] * y + response[c, 2] * z + response[c, 3]
                image[v, u, c] = value if valid[v, u] > 0 else np.float32(0)


@kernel
def _take_back(first, last, valid, clear, behind, response, shown, by_shown, by_planes, by_behind, sums):
    """The way back of ``_show``: to the planes, to the colours behind them, and sums for the response."""
    for v in range(first, last):
        for u in range(valid.shape[1]):
            by_alpha = np.float32(0)
            for c in range(3):
                g = by_shown[v, u, c]
                sums[0, c] += g * shown[v, u, c]
                sums[1, c] += g
                by_colour = np.float32(0)
                for k in range(3):
                    by_colour += response[k, c] * by_shown[v, u, k]
                if valid[v, u] == 0:
                    by_colour = np.float32(0)
                by_planes[1 + c, v, u] = by_colour
                by_behind[c, v, u] = by_colour * clear[v, u]
                by_alpha -= by_colour * behind[c, v, u]
            by_planes[0, v, u] = by_alpha
