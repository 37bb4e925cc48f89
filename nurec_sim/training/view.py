"""A training step as one picture: predictions for the input images next to the ground truth, and renderings."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from nurec_sim.network.tensors import ContextMaps, SemanticClass
from nurec_sim.training.data.sample import TrainingSample

TILE_WIDTH_PX = 208
MARGIN_PX, CAPTION_PX = 4, 16
MOST_ROWS = 4
"""Maximum number of input images (evenly sampled) and of rendered views."""
NEAREST_M, FARTHEST_M = 2.0, 120.0
"""Range of the logarithmic colour scale of depth: near is red, far is blue, unknown is black."""
DIFFERENCE_GAIN = 3.0
CLASS_COLOURS = {
    SemanticClass.OTHERS: (110, 110, 110),
    SemanticClass.EGO: (200, 60, 200),
    SemanticClass.SKY: (135, 206, 235),
    SemanticClass.ROAD: (128, 64, 128),
    SemanticClass.MOVABLE: (235, 90, 40),
}
PAPER, INK = 255, 40

Image = UInt8[np.ndarray, "h w 3"]


def sample_sheet(
    sample: TrainingSample, context: ContextMaps, renders: Sequence[Float[np.ndarray, "h w 3"]] = ()
) -> Image:
    """One row per input image: image, depth, classes and normals, each next to its ground truth; then rendered views.

    Args:
        sample: inputs and ground truth; b = 1.
        context: predictions of the network.
        renders: renderings of the sample's first targets, 0..1; may be empty.
    """
    truth = sample.truth
    rows = []
    for image in _spread(sample.inputs.rgb.shape[1]):
        depth_m, true_m = _array(context.depth_m[0, image]), _array(truth.depth_m[0, image])
        rows.append(
            [
                ("input", _colours(_array(sample.inputs.rgb[0, image]))),
                (_depth_caption(depth_m, true_m), _depth(depth_m)),
                ("true depth", _depth(true_m)),
                ("classes", _classes(_array(context.logits[0, image]).argmax(-1))),
                ("true classes", _classes(_array(truth.semantic[0, image]))),
                ("normals", _normals(_array(context.normal[0, image]))),
                ("true normals", _normals(_array(truth.normal[0, image]))),
            ]
        )
    shown = list(zip(renders, sample.targets, strict=False))
    pairs = [_view_tiles(np.asarray(render), _array(target.rgb)) for render, target in shown[:MOST_ROWS]]
    for first in range(0, len(pairs), 2):
        rows.append([tile for pair in pairs[first : first + 2] for tile in pair])
    return _pasted(rows)


def _depth_caption(depth_m: np.ndarray, true_m: np.ndarray) -> str:
    known = true_m > 0
    if not known.any():
        return "depth"
    return f"depth, AbsRel {float(np.mean(np.abs(depth_m - true_m)[known] / true_m[known])):.3f}"


def _view_tiles(render: np.ndarray, true: np.ndarray) -> list[tuple[str, Image]]:
    error = np.abs(render - true)
    psnr = -10 * np.log10(max(float((error**2).mean()), 1e-10))
    return [
        (f"rendered, {psnr:.1f} dB", _colours(render)),
        ("true view", _colours(true)),
        (f"difference x {DIFFERENCE_GAIN:g}", _colours(DIFFERENCE_GAIN * error)),
    ]


def _spread(count: int) -> list[int]:
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, MOST_ROWS))})


def _array(values: Tensor) -> np.ndarray:
    plain = values.detach().cpu()
    return (plain.float() if plain.is_floating_point() else plain).numpy()


def _colours(rgb: Float[np.ndarray, "h w 3"]) -> Image:
    return (np.nan_to_num(rgb).clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _depth(depth_m: Float[np.ndarray, "h w"]) -> Image:
    known = np.isfinite(depth_m) & (depth_m > 0)
    place = np.log(np.where(known, depth_m, NEAREST_M) / NEAREST_M) / np.log(FARTHEST_M / NEAREST_M)
    level = (255 * (1 - place.clip(0, 1))).astype(np.uint8)
    return np.where(known[..., None], cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1], 0).astype(np.uint8)


def _classes(semantic: Int64[np.ndarray, "h w"]) -> Image:
    """Class colours, black where the class is unknown."""
    table = np.zeros((len(SemanticClass) + 1, 3), np.uint8)
    for each, colour in CLASS_COLOURS.items():
        table[each] = colour
    return table[semantic]  # -1 is the last row


def _normals(normal: Float[np.ndarray, "h w 3"]) -> Image:
    """Right is red, up green and towards the camera blue; black where unknown."""
    known = (normal != 0).any(-1, keepdims=True)
    return np.where(known, _colours(normal * np.array([0.5, -0.5, -0.5]) + 0.5), 0).astype(np.uint8)


def _pasted(rows: Sequence[Sequence[tuple[str, Image]]]) -> Image:
    """Captioned tiles of equal width on white; rows are as high as their highest tile."""
    scaled = [[(name, _scaled(image)) for name, image in row] for row in rows]
    width = MARGIN_PX + max(len(row) for row in scaled) * (TILE_WIDTH_PX + MARGIN_PX)
    heights = [max(image.shape[0] for _, image in row) + CAPTION_PX + MARGIN_PX for row in scaled]
    sheet = np.full((MARGIN_PX + sum(heights), width, 3), PAPER, np.uint8)
    top = MARGIN_PX
    for row, height in zip(scaled, heights, strict=True):
        for column, (name, image) in enumerate(row):
            left = MARGIN_PX + column * (TILE_WIDTH_PX + MARGIN_PX)
            cv2.putText(sheet, name, (left, top + CAPTION_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (INK,) * 3, 1,
                        cv2.LINE_AA)  # fmt: skip
            start = top + CAPTION_PX
            sheet[start : start + image.shape[0], left : left + TILE_WIDTH_PX] = image
        top += height
    return sheet


def _scaled(image: Image) -> Image:
    size = (TILE_WIDTH_PX, max(1, round(image.shape[0] * TILE_WIDTH_PX / image.shape[1])))
    smaller = size[0] < image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
