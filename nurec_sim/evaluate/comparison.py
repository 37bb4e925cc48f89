"""Comparison of scenes of one log: the same figures for each, the worst frames, and a video with difference maps."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from nurec_sim import display
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.image_scores import image_request
from nurec_sim.evaluate.log import score_scene, sensing
from nurec_sim.evaluate.log_tables import side_by_side
from nurec_sim.evaluate.scores.flip import flip_map
from nurec_sim.logs.alignment import aligned_as
from nurec_sim.logs.held_out import HeldOut
from nurec_sim.runs.video import write_video
from nurec_sim.types import CameraFrame, Clip, GaussianScene, Sense

WIDTH_PX = 480
"""Width of one image in a row of the video and of the worst frames."""
WORST = 4
SHOWN_PX = 800
"""Width of a row in a notebook."""
FRAMES_PER_S = 5
BAR_PX = 20

Picture = UInt8[np.ndarray, "h w 3"]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        clip: id of the log.
        figures: scores by scene name, see ``log.score_scene``.
        worst: captions and pictures of the worst frames of each scene: recorded image and all scenes in the upper row,
            FLIP difference maps in the lower one.
        video: the same for all frames of the first target camera, as MP4.
    """

    clip: str
    figures: Mapping[str, Mapping[str, Any]]
    worst: Sequence[tuple[str, Picture]]
    video: bytes

    def __repr__(self) -> str:
        return f"Comparison({', '.join(self.figures)} on {self.clip!r}, video of {len(self.video) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        """All figures side by side and the two worst frames, for notebooks."""
        rows = [
            (group, name, *("" if cell is None else cell.text for cell in cells))
            for group, name, cells in side_by_side(self.figures)
        ]
        pictures = (
            display.table(caption, []) + display.image_tag(display.jpeg(display.thumbnail(picture, SHOWN_PX), 80))
            for caption, picture in self.worst[:2]
        )
        return display.table(f"log {self.clip}", rows, ("", "figure", *self.figures)) + "".join(pictures)


def compare_scenes(
    clip: Clip,
    scenes: Mapping[str, Callable[[], GaussianScene]],
    held: HeldOut | None = None,
    *,
    target_cameras: Sequence[str] | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> Comparison:
    """Scores scenes of a log one after the other, and renders them side by side.

    Args:
        clip: the log.
        scenes: loaders of two or more scenes by name; only one scene is in memory at a time.
        held: images and sweeps held out from all reconstructions.
        target_cameras: cameras to compare with; the first scene's input cameras if None.
        device: rendering device.
        progress: called with a stage and the fraction of all work done.

    Raises:
        ReconstructError: fewer than two scenes, an unknown camera, a scene of another log.
    """
    if len(scenes) < 2:
        raise ReconstructError(f"a comparison needs two scenes or more, got {list(scenes)}")
    report = progress or (lambda stage, fraction: None)
    figures: dict[str, dict[str, Any]] = {}
    shown: dict[str, dict[tuple[str, int], Picture]] = {}
    for done, (name, load) in enumerate(scenes.items()):

        def part(stage: str, fraction: float, name: str = name, done: int = done) -> None:
            """Reports the progress of one scene as part of the whole.

            Args:
                stage: what is being done.
                fraction: share of this scene's work done.
                name: the scene; bound here, since the loop variable changes.
                done: number of scenes finished before it.
            """
            report(f"{name}: {stage}", (done + fraction) / len(scenes))

        scene = load()
        figures[name] = score_scene(
            clip, scene, held, target_cameras=target_cameras, via_grpc=False, device=device,
            progress=lambda stage, fraction: part(stage, 0.9 * fraction),
        )  # fmt: skip
        # All scenes must be scored on the cameras of the first one, otherwise their figures are not comparable.
        target_cameras = figures[name]["target_cameras"]
        with sensing(scene, False, device) as sense:
            shown[name] = _pictures(aligned_as(clip, scene), target_cameras, sense)
    frames = [frame for frame in next(iter(shown.values())) if frame[0] == target_cameras[0]] if target_cameras else []
    worst = _worst_frames(figures)
    report("pictures", 1.0)
    return Comparison(
        clip.id,
        figures,
        [(f"{camera}, frame {index}", _row(clip, (camera, index), shown)) for camera, index in worst],
        _video([_row(clip, frame, shown) for frame in frames]),
    )


def _pictures(clip: Clip, cameras: Sequence[str], sense: Sense) -> dict[tuple[str, int], Picture]:
    """All frames of some cameras, downsampled."""
    pictures = {}
    for camera in cameras:
        for index in range(len(clip.camera_times_us(camera))):
            (frame,) = sense([image_request(clip, camera, index)])
            assert isinstance(frame, CameraFrame)
            pictures[camera, index] = _small(frame.rgb)
    return pictures


def _small(picture: Picture) -> Picture:
    """Downsampled to even sides, as chroma subsampling (yuv420p) requires."""
    height = max(round(picture.shape[0] * WIDTH_PX / picture.shape[1] / 2) * 2, 2)
    return cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)


def _worst_frames(figures: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, int]]:
    """Frames with the lowest PSNR of each scene, taken from the scenes in turn, without repetition."""
    ranked = []
    for each in figures.values():
        rows = [
            (value, camera, index)
            for camera, scores in each["image"]["cameras"].items()
            for index, value in enumerate(scores["per_frame"]["psnr_db"])
        ]
        ranked.append([(camera, index) for _, camera, index in sorted(rows)])
    turns = [frame for place in zip(*ranked, strict=True) for frame in place]
    return list(dict.fromkeys(turns))[:WORST]


def _row(clip: Clip, frame: tuple[str, int], shown: Mapping[str, Mapping[tuple[str, int], Picture]]) -> Picture:
    """Recorded image and all scenes side by side; below each scene its FLIP map, dark where it agrees."""
    recorded = _small(clip.image(*frame))
    upper, lower = [_captioned(recorded, "recorded")], [np.full_like(recorded, 250)]
    for name, pictures in shown.items():
        difference = flip_map(pictures[frame], recorded)
        upper.append(_captioned(pictures[frame], f"{name}   FLIP {difference.mean():.3f}"))
        levels = np.rint(255 * np.clip(difference, 0, 1)).astype(np.uint8)
        lower.append(cv2.applyColorMap(levels, cv2.COLORMAP_MAGMA)[..., ::-1])
    return np.vstack([np.hstack(upper), np.hstack(lower)])


def _captioned(picture: Picture, text: str) -> Picture:
    bar = np.full((BAR_PX, picture.shape[1], 3), 250, np.uint8)
    cv2.putText(bar, text, (4, BAR_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack([bar, picture])


def _video(pictures: Sequence[Picture]) -> bytes:
    """An H.264 video in MP4; empty without pictures."""
    # Through a file: its index is moved to the front once it is finished, which needs a name.
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "frames.mp4"
        write_video(file, pictures, FRAMES_PER_S)
        return file.read_bytes() if file.exists() else b""
