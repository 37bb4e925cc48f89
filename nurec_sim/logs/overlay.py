"""A contact sheet of all cameras at one time, overlaid with LiDAR points and boxes, for visual inspection."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.geometry import BOX_CORNERS
from nurec_sim.logs.checks.sampling import pose_at
from nurec_sim.logs.clip import Clip
from nurec_sim.types import CameraModel, Matrix4, Sweep

TILE_PX = 960
COLUMNS = 3
CAPTION_PX = 28
NEAR_M, FAR_M = 2.0, 80.0
"""Range of the colour map, logarithmic in depth."""
DOT_PX = 2
EDGE_STEPS = 12
BOX_RGB = (255, 255, 255)
CAPTION_RGB = (235, 235, 235)
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(BOX_CORNERS[a] - BOX_CORNERS[b]).sum() == 1]

Image = UInt8[np.ndarray, "h w 3"]


def draw_overlay(clip: Clip, t_us: int) -> Image:
    """Every camera's image nearest to a time, overlaid with each LiDAR's nearest sweep and the boxes at that time.

    Points are coloured by depth, from red at 2 m to blue at 80 m; boxes are white, with a cross on the front face. A
    camera without images, or whose image cannot be read, gets a black tile with a note.

    Raises:
        ClipError: the clip has no cameras, or the time is outside the clip.
    """
    start_us, end_us = clip.span_us
    if not clip.rig.cameras:
        raise ClipError(f"clip {clip.id!r} has no cameras to draw over")
    if not start_us <= t_us < end_us:
        raise ClipError(
            f"clip {clip.id!r} lasts {(end_us - start_us) / 1e6:.3f} s; "
            f"there is nothing to draw {(t_us - start_us) / 1e6:.3f} s after its start"
        )
    tiles = [draw_camera(clip, name, t_us) for name in clip.rig.cameras]
    columns = min(COLUMNS, int(np.ceil(np.sqrt(len(tiles)))))
    height = max(tile.shape[0] for tile in tiles)
    sheet = np.zeros((-(-len(tiles) // columns) * height, columns * TILE_PX, 3), np.uint8)
    for index, tile in enumerate(tiles):
        row, column = divmod(index, columns)
        sheet[row * height : row * height + tile.shape[0], column * TILE_PX : column * TILE_PX + TILE_PX] = tile
    return sheet


def draw_camera(clip: Clip, camera_id: str, t_us: int) -> Image:
    """One camera's overlaid image below its caption, ``TILE_PX`` wide; see ``draw_overlay``."""
    import cv2

    camera = clip.rig.cameras[camera_id]
    scale = TILE_PX / camera.width_px
    shown = sensors.scaled_camera(camera, TILE_PX, max(1, round(camera.height_px * scale)))
    image = np.zeros((shown.height_px, TILE_PX, 3), np.uint8)
    times = clip.camera_times_us(camera_id).mean(axis=1)
    if len(times) == 0:
        return _captioned(f"{camera_id}: no images", image)
    index = int(np.argmin(np.abs(times - t_us)))
    try:
        pixels = clip.image(camera_id, index)
    except ClipError as error:
        return _captioned(f"{camera_id} frame {index}: {error}", image)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    image = cv2.resize(pixels, (TILE_PX, shown.height_px), interpolation=how).astype(np.uint8)
    poses = clip.world_from_camera(camera_id, index)
    told = [f"{camera_id} frame {index}, {(times[index] - clip.span_us[0]) / 1e6:.3f} s"]
    for name, sweep in _sweeps(clip, times[index]):
        draw_points(image, shown, poses, sweep.xyz_world_m)
        told.append(f"{name} {(sweep.t_us - times[index]) / 1e3:+.0f} ms")
    for track in clip.tracks:
        world_from_box = pose_at(track, int(times[index]))
        if world_from_box is not None:
            draw_box(image, shown, poses, track.size_m, world_from_box)
    return _captioned(", ".join(told), image)


def _sweeps(clip: Clip, t_us: float) -> Iterator[tuple[str, Sweep]]:
    """The sweep of each LiDAR nearest to a time, if it can be read."""
    for name in clip.rig.lidars:
        times = np.array([record.t_us for record in clip.sweep_records(name)])
        if len(times):
            try:
                yield name, clip.sweep(name, int(np.argmin(np.abs(times - t_us))))
            except ClipError:
                continue


def draw_points(
    image: Image, camera: CameraModel, poses: Float64[np.ndarray, "2 4 4"], xyz_world_m: Float64[np.ndarray, "n 3"]
) -> None:
    """Draws points into a camera's image as dots coloured by depth, farthest first, so that near ones cover them.

    Args:
        image: what is drawn into, of the camera's size.
        camera: its lens and shutter.
        poses: ``world_from_camera`` at the start and the end of the exposure.
        xyz_world_m: the points.
    """
    uv, valid, _ = sensors.project_rolling(camera, poses, xyz_world_m)
    seen = np.flatnonzero(valid & sensors.in_image(camera, uv))
    # Depth at the start of the exposure is enough for a colour.
    depth = geometry.transform_points(geometry.inverse(poses[0]), xyz_world_m[seen])[:, 2]
    order = np.argsort(-depth)
    columns, rows = np.floor(uv[seen[order]]).astype(np.int64).T
    rgb = depth_rgb(depth[order])
    for right, down in itertools.product(range(DOT_PX), repeat=2):
        image[np.minimum(rows + down, camera.height_px - 1), np.minimum(columns + right, camera.width_px - 1)] = rgb


def depth_rgb(depth_m: Float64[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours of depths: red near, blue far."""
    import cv2

    # Turbo runs from blue to red: reversed, so that near is red. OpenCV returns BGR.
    share = np.log(np.clip(depth_m, NEAR_M, FAR_M) / NEAR_M) / np.log(FAR_M / NEAR_M)
    bgr = cv2.applyColorMap(np.rint(255 * (1 - share)).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO)
    return np.ascontiguousarray(bgr[:, 0, ::-1])


def draw_box(
    image: Image,
    camera: CameraModel,
    poses: Float64[np.ndarray, "2 4 4"],
    size_m: tuple[float, float, float],
    world_from_box: Matrix4,
    rgb: tuple[int, int, int] = BOX_RGB,
) -> None:
    """Draws a box's twelve edges and a cross on its front face; arguments as those of ``draw_lines``."""
    front = [index for index, corner in enumerate(BOX_CORNERS) if corner[0] > 0]
    ends = BOX_CORNERS[[*_EDGES, (front[0], front[3]), (front[1], front[2])]] * np.array(size_m)
    share = np.linspace(0, 1, EDGE_STEPS + 1)[:, None]
    lines = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])
    draw_lines(image, camera, poses, geometry.transform_points(world_from_box, lines), rgb)


def draw_lines(
    image: Image,
    camera: CameraModel,
    poses: Float64[np.ndarray, "2 4 4"],
    lines_m: Float64[np.ndarray, "k s 3"],
    rgb: tuple[int, int, int],
    width_px: int = 1,
) -> None:
    """Draws polylines into a camera's image; lenses bend straight lines, so long ones need many points.

    Args:
        image: what is drawn into, of the camera's size.
        camera: its lens and shutter.
        poses: ``world_from_camera`` at the start and the end of the exposure.
        lines_m: k lines of s points in the world.
        rgb: their colour.
        width_px: their width.
    """
    import cv2

    uv, valid, _ = sensors.project_rolling(camera, poses, lines_m.reshape(-1, 3))
    seen = (valid & sensors.in_image(camera, uv)).reshape(lines_m.shape[:2])
    # OpenCV counts pixel centres as whole numbers.
    place = np.rint(np.where(seen[..., None], uv.reshape(*seen.shape, 2), 0) - 0.5).astype(np.int64)
    # Only segments with both ends in the image: a point behind the camera has no meaningful pixel.
    for line, step in zip(*np.nonzero(seen[:, 1:] & seen[:, :-1]), strict=True):
        one, two = place[line, step].tolist(), place[line, step + 1].tolist()
        cv2.line(image, one, two, rgb, width_px, cv2.LINE_AA)


def _captioned(text: str, image: Image) -> Image:
    import cv2

    strip = np.zeros((CAPTION_PX, image.shape[1], 3), np.uint8)
    cv2.putText(strip, text, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, CAPTION_RGB, 1, cv2.LINE_AA)
    return np.concatenate([strip, image])
