"""What objects show of themselves in notebooks: tables, images, points from above, paths; arrays in, HTML or bytes out.

The types that have a look call these from ``_repr_html_``, ``_repr_jpeg_`` and ``_repr_png_``, the names by which
IPython asks. Pictures are small, because notebooks keep them.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float64, UInt8

SIDE_PX = 420
"""Longer side of pictures from above and of drawings of paths."""
THUMBNAIL_PX = 240
BACKGROUND_RGB = (15, 23, 42)
SPARK_PX = (240, 40)
SWEEP_M, SWEEP_HEIGHT_M = 40.0, (-2.0, 2.0)
"""Sweeps are drawn up to this distance, with colours from the lower to the higher z."""

Image = UInt8[np.ndarray, "h w 3"]


def jpeg(rgb: Image, quality: int = 88) -> bytes:
    """An image as JPEG: a tenth of a PNG's size for what a camera sees."""
    import cv2

    coded: bytes = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    return coded


def png(rgb: Image) -> bytes:
    """An image as PNG."""
    import cv2

    coded: bytes = cv2.imencode(".png", rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return coded


def thumbnail(rgb: Image, width_px: int = THUMBNAIL_PX) -> Image:
    """An image scaled down to a width; the same image if it is not wider."""
    import cv2

    height, width = rgb.shape[:2]
    if width <= width_px:
        return rgb
    size = width_px, max(1, round(height * width_px / width))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def colours(values: Float[np.ndarray, " n"], low: float, high: float) -> UInt8[np.ndarray, "n 3"]:
    """Values as colours from blue (``low``) to red (``high``)."""
    import cv2

    level = np.rint(255 * np.clip((values - low) / (high - low), 0, 1)).astype(np.uint8).reshape(-1, 1)
    return np.ascontiguousarray(cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[:, 0, ::-1]).astype(np.uint8)


def from_above(
    xyz_m: Float[np.ndarray, "n 3"],
    rgb: UInt8[np.ndarray, "n 3"],
    low_m: Sequence[float],
    high_m: Sequence[float],
) -> Image:
    """Points seen from above, higher ones over lower ones; x to the right, y up.

    Args:
        xyz_m: the points.
        rgb: their colours.
        low_m: smallest x and y in the picture.
        high_m: largest x and y in the picture; its longer side gets ``SIDE_PX`` pixels.
    """
    low, high = np.asarray(low_m, np.float64)[:2], np.asarray(high_m, np.float64)[:2]
    scale = SIDE_PX / max(float((high - low).max()), 1e-6)
    width, height = (max(1, int(np.ceil(side * scale))) for side in high - low)
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = BACKGROUND_RGB
    order = np.argsort(xyz_m[:, 2], kind="stable")
    right = np.floor((xyz_m[order, 0] - low[0]) * scale)
    down = np.floor((high[1] - xyz_m[order, 1]) * scale)
    inside = (right >= 0) & (right < width) & (down >= 0) & (down < height)
    # Of several points in a pixel the last one stays, which is the highest.
    picture[down[inside].astype(np.int64), right[inside].astype(np.int64)] = rgb[order][inside]
    return picture


def sweep_png(xyz_m: Float[np.ndarray, "n 3"]) -> bytes:
    """A LiDAR sweep in its sensor frame from above, up to ``SWEEP_M`` away, forwards to the right; colour is height."""
    low, high = SWEEP_HEIGHT_M
    return png(from_above(xyz_m, colours(xyz_m[:, 2], low, high), [-SWEEP_M, -SWEEP_M], [SWEEP_M, SWEEP_M]))


def image_tag(data: bytes) -> str:
    """A JPEG inside HTML."""
    return f'<img src="data:image/jpeg;base64,{base64.b64encode(data).decode()}" style="margin:2px">'


def table(title: str, rows: Sequence[Sequence[object]], heading: Sequence[str] = ()) -> str:
    """Rows as an HTML table below a title."""

    def row(cells: Sequence[object], tag: str) -> str:
        told = (f'<{tag} style="text-align:left">{html.escape(str(cell))}</{tag}>' for cell in cells)
        return f"<tr>{''.join(told)}</tr>"

    lines = [row(heading, "th")] if heading else []
    lines += [row(cells, "td") for cells in rows]
    return f"<div><b>{html.escape(title)}</b><table>{''.join(lines)}</table></div>"


def paths(lines_m: Mapping[str, tuple[Float64[np.ndarray, "n 2"], str]]) -> str:
    """Paths from above as an SVG with a legend, x to the right and y up; name -> points and colour."""
    drawn = {name: (points, colour) for name, (points, colour) in lines_m.items() if len(points)}
    if not drawn:
        return ""
    every = np.concatenate([points for points, _ in drawn.values()])
    low, high = every.min(axis=0) - 2, every.max(axis=0) + 2
    scale = SIDE_PX / float((high - low).max())
    width, height = (high - low) * scale
    parts = []
    for index, (name, (points, colour)) in enumerate(drawn.items()):
        places = np.column_stack([(points[:, 0] - low[0]) * scale, (high[1] - points[:, 1]) * scale])
        parts.append(_polyline(places, colour))
        parts.append(f'<text x="4" y="{height + 16 * (index + 1):.0f}" fill="{colour}">{html.escape(name)}</text>')
    return _svg(float(width), float(height) + 16 * len(drawn) + 8, parts)


def spark(t: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]) -> str:
    """Values over time as a small SVG line from the lowest to the highest."""
    if not len(values):
        return ""
    width, height = SPARK_PX
    across = (t - t[0]) / max(float(t[-1] - t[0]), 1e-9) * (width - 4) + 2
    down = height - 2 - (values - values.min()) / max(float(np.ptp(values)), 1e-9) * (height - 4)
    return _svg(width, height, [_polyline(np.column_stack([across, down]), "#2563eb")])


def _polyline(places: Float[np.ndarray, "n 2"], colour: str) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>'


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg width="{width:.0f}" height="{height:.0f}" font-size="12" font-family="sans-serif">{"".join(parts)}</svg>'
    )
