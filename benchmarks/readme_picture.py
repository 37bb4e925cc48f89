"""Draws docs/images/chain.png: a recorded frame of the shipped log, and what its reconstruction shows."""

from importlib import resources
from pathlib import Path

import cv2
import numpy as np

from nurec_sim import geometry
from nurec_sim.logs import open_clip
from nurec_sim.render import CpuRenderer
from nurec_sim.render.images.still import picture
from nurec_sim.serving.store import SceneStore
from nurec_sim.types import SensorRequest

CAMERA, FRAME, LEFT_M = "camera_front", 22, 1.5
GAP_PX, TEXT_PX = 6, 24


def main() -> None:
    path = Path(str(resources.files("nurec_sim.scenarios") / "demo_clip.zip"))
    clip = open_clip(path)
    store = SceneStore([path])
    renderer = CpuRenderer(store.get(store.ids[0]).scene)
    pose = clip.world_from_camera(CAMERA, FRAME)
    t_us = int(clip.camera_times_us(CAMERA)[FRAME, 0])
    camera = clip.rig.cameras[CAMERA]
    # The camera's own left is minus x.
    beside = pose @ geometry.pose(np.eye(3), np.array([-LEFT_M, 0.0, 0.0]))
    there = renderer.render_camera(SensorRequest(clip.id, camera, t_us, t_us + 1, pose))
    moved = renderer.render_camera(SensorRequest(clip.id, camera, t_us, t_us + 1, beside))
    tiles = [
        [("recorded", clip.image(CAMERA, FRAME)), ("rendered from the reconstruction", there.rgb)],
        [(f"rendered {LEFT_M} m to the left, where nobody drove", moved.rgb), ("its labels", picture(moved, "label"))],
    ]
    sheet = np.vstack([np.hstack([titled(text, image) for text, image in row]) for row in tiles])
    target = Path(__file__).parent.parent / "docs" / "images" / "chain.png"
    cv2.imwrite(str(target), np.ascontiguousarray(sheet[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"wrote {target.relative_to(Path.cwd()) if target.is_relative_to(Path.cwd()) else target}")


def titled(text: str, image: np.ndarray) -> np.ndarray:
    """An image with a line of text above and a border."""
    tile = cv2.copyMakeBorder(image, TEXT_PX, GAP_PX, GAP_PX, GAP_PX, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(tile, text, (GAP_PX, TEXT_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return tile


if __name__ == "__main__":
    main()
