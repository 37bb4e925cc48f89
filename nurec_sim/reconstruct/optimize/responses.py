"""How each frame of a camera shows colours: the camera's response with a gain and an offset of the frame's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.reconstruct.optimize.adam import RowAdam
from nurec_sim.types import GaussianScene, Rig

GAINS = (0.5, 2.0)
"""A frame's gains begin within these."""


class FrameResponses:
    """Logarithms of gains and offsets per channel of every frame, [2,3], and their moments.

    Shown colour = ``exp(gain) * (given[:, :3] @ colour + given[:, 3]) + offset``, where ``given`` is the response that
    the scene comes with: of the frame, else of its camera. They are pulled towards 0, so that colours are kept.
    """

    def __init__(self, scene: GaussianScene, frames: Mapping[str, int]) -> None:
        isp, self._exposures = scene.isp, scene.exposures
        self._given = {
            name: np.asarray(scene.exposures.get(name, [isp.get(name, np.eye(3, 4))] * count), np.float64)
            for name, count in frames.items()
        }
        self.values = {name: np.zeros((count, 2, 3)) for name, count in frames.items()}
        self.adam = {name: RowAdam(values.shape) for name, values in self.values.items()}

    def of(self, camera: str, frame: int) -> Float64[np.ndarray, "3 4"]:
        """Shown colour = ``[:, :3] @ colour + [:, 3]``; between the frames beside it if a frame was not fitted."""
        values, fitted = self.values[camera], np.flatnonzero(self.adam[camera].visits)
        gain, offset = values[frame]
        if self.is_new(camera, frame) and len(fitted):
            after = min(int(np.searchsorted(fitted, frame)), len(fitted) - 1)
            before = fitted[max(after - 1, 0)] if fitted[after] > frame else fitted[after]
            share = np.clip((frame - before) / max(fitted[after] - before, 1), 0, 1)
            gain, offset = values[before] * (1 - share) + values[fitted[after]] * share
        shown = np.exp(gain)[:, None] * self._given[camera][frame]
        shown[:, 3] += offset
        return shown

    def start(
        self, camera: str, frame: int, shown: Float32[np.ndarray, "h w 3"], recorded: Float32[np.ndarray, "h w 3"]
    ) -> None:
        """Set the gains of a frame without a given response to the ratio of the images' mean colours.

        Args:
            camera: id of the camera.
            frame: index among its images.
            shown: the rendered image.
            recorded: the image of the log.
        """
        if camera in self._exposures:
            return
        ratio = recorded.mean(axis=(0, 1), dtype=np.float64) / np.maximum(shown.mean(axis=(0, 1)), 1e-3)
        self.values[camera][frame, 0] = np.log(np.clip(ratio, *GAINS))

    def is_new(self, camera: str, frame: int) -> bool:
        """Whether a frame has not been fitted yet."""
        return bool(self.adam[camera].visits[frame] == 0)

    def step(
        self,
        camera: str,
        frame: int,
        sums: Float64[np.ndarray, "2 3"],
        rate: float,
        weight: float,
    ) -> None:
        """One step of Adam on the gains and offsets of one frame.

        Args:
            camera: id of the camera.
            frame: index among its images.
            sums: per channel over all pixels, of the loss's gradient by the shown image times that image, and of the
                gradient alone.
            rate: learning rate.
            weight: of the squares of log gains and offsets in the loss.
        """
        values = self.values[camera][frame]
        # shown = exp(gain) x + offset, so d shown / d gain = shown - offset, and d shown / d offset = 1.
        by_offset = sums[1]
        by_gain = sums[0] - by_offset * values[1]
        gradient = np.stack([by_gain, by_offset]) + 2 * weight * values
        self.adam[camera].step(frame, self.values[camera], gradient, rate)

    def all(self) -> dict[str, Float64[np.ndarray, "frames 3 4"]]:
        """Responses of all frames by camera."""
        return {name: np.array([self.of(name, k) for k in range(len(v))]) for name, v in self.values.items()}


def borrowed_responses(
    responses: Mapping[str, Float64[np.ndarray, "frames 3 4"]],
    times_us: Mapping[str, np.ndarray],
    rig: Rig,
    cameras: Sequence[str],
) -> dict[str, Float64[np.ndarray, "frames 3 4"]]:
    """Responses of cameras that were not fitted: those of the most similar fitted camera, at the same instants.

    A pair of cameras of one kind on one car is exposed alike. Similar means equal lens type and image size; of several
    such cameras the one closest in viewing direction counts. A camera unlike all others gets none.

    Args:
        responses: of the fitted cameras, by frame.
        times_us: start and end of the exposures of every camera, [frames,2].
        rig: the cameras.
        cameras: ids of the cameras that need a response.
    """
    borrowed = {}
    for name in cameras:
        model = rig.cameras[name]
        like = [
            other
            for other in responses
            if (rig.cameras[other].width_px, rig.cameras[other].height_px) == (model.width_px, model.height_px)
            and type(rig.cameras[other].lens) is type(model.lens)
        ]
        if not like or not len(times_us[name]):
            continue
        nearest = max(like, key=lambda o: float(rig.cameras[o].rig_from_camera[:3, 2] @ model.rig_from_camera[:3, 2]))
        if rig.cameras[nearest].rig_from_camera[:3, 2] @ model.rig_from_camera[:3, 2] < 0.7:
            continue
        own, theirs = (np.asarray(times_us[n], np.int64).sum(axis=1) // 2 for n in (name, nearest))
        flat = responses[nearest].reshape(len(theirs), 12)
        columns = [np.interp(own, theirs, flat[:, k]) for k in range(12)]
        borrowed[name] = np.stack(columns, axis=1).reshape(len(own), 3, 4)
    return borrowed
