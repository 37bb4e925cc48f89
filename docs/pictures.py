"""Makes the pictures of README, the gallery and docs/trust.md from the log that ships with the package.

nurec-sim demo --save-log demo.zip && nurec-sim reconstruct demo.zip --out demo.usdz
python docs/pictures.py demo.zip demo.usdz
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from nurec_sim import display, logs, render, scene
from nurec_sim.render.images.still import support_picture, view_request

IMAGES = Path(__file__).parent / "images"
BAR_PX, GAP_PX = 24, 4
FRAMES = {"straight": ("camera_front", 8), "turn": ("camera_front", 28), "side": ("camera_front_left", 31)}
"""Name of a picture -> camera and frame."""
OFFSETS = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (0.0, 20.0)]
"""Of the car: metres to its left, degrees to its left."""
SUPPORT_AT_M = (0.0, 1.5, 3.0)
"""To its left, in the picture of support."""


def captioned(rgb: np.ndarray, text: str) -> np.ndarray:
    """A picture below a line of text."""
    bar = np.full((BAR_PX, rgb.shape[1], 3), 250, np.uint8)
    cv2.putText(bar, text, (4, BAR_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return np.pad(np.vstack([bar, rgb]), ((0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=250)


def sheet(pictures: list[np.ndarray], columns: int) -> np.ndarray:
    """Pictures of one size in rows."""
    rows = [np.hstack(pictures[start : start + columns]) for start in range(0, len(pictures), columns)]
    return np.vstack(rows)


def main(log: Path, archive: Path) -> None:
    """Write all pictures."""
    clip = logs.open_clip(log)
    renderer = render.make_renderer(scene.read_scene(archive))
    for name, (camera, frame) in FRAMES.items():
        pictures = [captioned(clip.image(camera, frame), "recorded")]
        for left_m, yaw_deg in OFFSETS:
            text = (
                f"rendered, {left_m:g} m to the left" if not yaw_deg else f"rendered, turned {yaw_deg:g} degrees left"
            )
            if not left_m and not yaw_deg:
                text = "rendered, same pose"
            view = render.render_view(renderer, camera, frame, left_m=left_m, yaw_deg=yaw_deg)
            pictures.append(captioned(view.rgb, text))
        (IMAGES / f"gallery_{name}.jpg").write_bytes(display.jpeg(sheet(pictures, 2), 60))
        if name == "turn":
            chain = [pictures[0], pictures[1], captioned(render.render_view(renderer, camera, frame, left_m=1.5).rgb,
                                                         "rendered, 1.5 m to the left")]  # fmt: skip
            (IMAGES / "chain.jpg").write_bytes(display.jpeg(sheet(chain, 3), 78))
            requests = [view_request(renderer.scene, camera, frame, left_m=left_m) for left_m in SUPPORT_AT_M]
            shown = [support_picture(renderer, request) for request in requests]
            (IMAGES / "support.jpg").write_bytes(display.jpeg(sheet(shown, len(shown)), 78))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
