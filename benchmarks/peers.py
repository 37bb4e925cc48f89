"""What the renderer is compared with: a plain torch renderer of the same response, gsplat, and our own lesser kernels.

``torch_frame`` is written as one would without kernels: exact ellipsoid bounds, 16 x 16 tiles, and per tile a batch of
Gaussians by all of the tile's rays in ordinary tensor operations, with early stop. It renders the same image as the
renderer (its PSNR against the reference is in its row). Peers that cannot run here are named with what they said.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from timing import Render

from nurec_sim import geometry
from nurec_sim.render import spec
from nurec_sim.render.rays import ray_grid
from nurec_sim.types import CameraFrame, GaussianScene, Pinhole, SensorFrame, SensorRequest, Shutter

TILE_PX = 16
BATCH = 512
GSPLAT_PROBE = 64
NOT_RUN = {
    "OpenSplat": "a C++ program that must be built against libtorch; not on the package index",
    "3dgrut": "CUDA and OptiX only; not on the package index",
    "brush": "a Rust program that needs a GPU through WebGPU",
}


def torch_frame(scene: GaussianScene, request: SensorRequest, threads: int = 2) -> CameraFrame:
    """An image of an ideal pinhole camera with a global shutter: rgb, depth and alpha.

    Raises:
        ValueError: the camera is of another kind.
    """
    camera = request.sensor
    if camera.ideal_pinhole is None or camera.shutter is not Shutter.GLOBAL:
        raise ValueError("torch_frame renders ideal pinhole cameras with a global shutter")
    lens, width, height = camera.ideal_pinhole, camera.width_px, camera.height_px
    pose = np.asarray(request.world_from_sensor[0])
    grid = ray_grid(camera)
    gaussians, order = spec.visible_gaussians(scene, request, grid)
    ordered = gaussians[order]
    turn = torch.from_numpy(geometry.matrix_from_quat(ordered.quat_wxyz))
    mean = torch.from_numpy(geometry.transform_points(geometry.inverse(pose), ordered.mean_m))
    axes = torch.from_numpy(pose[:3, :3].T.copy()) @ turn  # camera from Gaussian
    scale = torch.from_numpy(ordered.scale_m).clamp_min(spec.MIN_SCALE_M)
    opacity = torch.from_numpy(ordered.opacity).clamp_max(spec.MAX_OPACITY)
    canonical = axes.transpose(1, 2) / scale.double()[:, :, None]
    origin = -torch.einsum("nij,nj->ni", canonical, mean)
    # Rows that a ray d is multiplied with: d' x o' and d' before they are normalised, and -d' . o'.
    crossed = -torch.linalg.cross(origin[:, :, None].expand_as(canonical), canonical, dim=1)
    along = -torch.einsum("ni,nij->nj", origin, canonical)
    forms = torch.cat([crossed, canonical, along[:, None]], dim=1).float()
    features = torch.cat([torch.from_numpy(ordered.rgb), torch.ones(len(mean), 1)], dim=1)

    tile_of, row_of = _tile_pairs(mean, axes * scale[:, None, :], opacity, lens, width, height)
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    starts = torch.searchsorted(tile_of, torch.arange(columns * rows + 1))
    image = torch.zeros(rows * TILE_PX, columns * TILE_PX, 5)
    v, u = torch.meshgrid(torch.arange(TILE_PX) + 0.5, torch.arange(TILE_PX) + 0.5, indexing="ij")

    def draw_tile(tile: int) -> None:
        row, column = tile // columns * TILE_PX, tile % columns * TILE_PX
        x, y = (u + column - lens.cx_px) / lens.fx_px, (v + row - lens.cy_px) / lens.fy_px
        ray = torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(-1, 3)
        picked = row_of[starts[tile] : starts[tile + 1]]
        blended = _blend_tile(ray, picked, forms, opacity, features)
        image[row : row + TILE_PX, column : column + TILE_PX] = blended.reshape(TILE_PX, TILE_PX, 5)

    # Tiles by threads of ours: torch's own would meet at a barrier after every small operation.
    torch.set_num_threads(1)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(draw_tile, range(columns * rows)))
    planes = image[:height, :width].double().numpy()
    return _finished(scene, request, planes)


def _tile_pairs(
    mean: torch.Tensor, half_axes: torch.Tensor, opacity: torch.Tensor, lens: Pinhole, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tiles and Gaussians that may meet: sorted by tile, within a tile by depth (in which the Gaussians come)."""
    squared = 2 * torch.log(opacity / spec.MIN_ALPHA).clamp_min(0)
    covariance = half_axes @ half_axes.transpose(1, 2) * squared[:, None, None]
    z = mean[:, 2]
    steep = z * z - covariance[:, 2, 2]
    first_last = []
    for axis, focal, centre, size in ((0, lens.fx_px, lens.cx_px, width), (1, lens.fy_px, lens.cy_px, height)):
        # Planes through the eye that touch the ellipsoid: two roots of a quadratic in the slope.
        middle = mean[:, axis] * z - covariance[:, axis, 2]
        product = mean[:, axis] ** 2 - covariance[:, axis, axis]
        root = (middle * middle - steep * product).clamp_min(0).sqrt()
        tiles = -(-size // TILE_PX)
        low = ((middle - root) / steep * focal + centre - 0.5) / TILE_PX
        high = ((middle + root) / steep * focal + centre + 0.5) / TILE_PX
        around = steep <= 1e-6 * z * z  # the eye's plane cuts the ellipsoid
        low = torch.where(around, torch.zeros_like(low), low).floor().clamp(0, tiles)
        high = torch.where(around, torch.full_like(high, tiles), high).ceil().clamp(0, tiles)
        first_last.append((low.long(), high.long()))
    (left, right), (top, bottom) = first_last
    across, down = (right - left).clamp_min(0), (bottom - top).clamp_min(0)
    counts = across * down
    row_of = torch.repeat_interleave(torch.arange(len(mean)), counts)
    place = torch.arange(len(row_of)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    columns = -(-width // TILE_PX)
    tile_of = (top[row_of] + place // across[row_of]) * columns + left[row_of] + place % across[row_of]
    tile_of, by_tile = torch.sort(tile_of, stable=True)
    return tile_of, row_of[by_tile]


def _blend_tile(ray, picked, forms, opacity, features) -> torch.Tensor:
    """Sums of colour, alpha and depth over a tile's rays [r,3], whose z is 1."""
    sums, through = torch.zeros(len(ray), 5), torch.ones(len(ray))
    for part in picked.split(BATCH):
        values = (forms[part].reshape(-1, 3) @ ray.T).reshape(len(part), 7, len(ray))
        squared = values[:, 3:6].square().sum(1)
        alpha = opacity[part][:, None] * torch.exp(values[:, :3].square().sum(1) / squared / -2)
        z = values[:, 6] / squared
        near = z * ray.norm(dim=-1) >= 0.2
        alpha = torch.where((alpha >= spec.MIN_ALPHA) & near, alpha, torch.zeros_like(alpha))
        after = through * torch.cumprod(1 - alpha, dim=0)
        before = torch.cat([through[None], after[:-1]])
        weight = torch.where(before > spec.MIN_TRANSMITTANCE, alpha * before, torch.zeros_like(alpha))
        sums[:, :4] += weight.T @ features[part]
        sums[:, 4] += (weight * z).sum(0)
        through = after[-1]
        if (through <= spec.MIN_TRANSMITTANCE).all():
            break
    return sums


def _finished(scene: GaussianScene, request: SensorRequest, planes: np.ndarray) -> CameraFrame:
    """Sky, colour correction and rounding, as the reference does them."""
    grid = ray_grid(request.sensor)
    direction = grid.direction @ np.asarray(request.world_from_sensor[0])[:3, :3].T
    alpha = planes[..., 3]
    isp = scene.isp.get(request.sensor.id)
    colour = spec.finish_colour(planes[..., :3], alpha, spec.sky_colour(scene.sky, direction), isp)
    depth = np.where(alpha >= spec.SURFACE_ALPHA, planes[..., 4] / np.maximum(alpha, spec.MIN_ALPHA), 0)
    return CameraFrame(request.sensor, request.start_us, request.end_us, spec.to_uint8(colour),
                       depth.astype(np.float32), alpha.astype(np.float32))  # fmt: skip


def gsplat_frame(scene: GaussianScene, request: SensorRequest) -> CameraFrame:
    """The same image by gsplat: unscented transform, response in three dimensions, hit depth; on a GPU if it has one.

    Raises:
        Exception: whatever gsplat says where it cannot run.
    """
    gsplat = importlib.import_module("gsplat")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    camera = request.sensor
    lens = camera.ideal_pinhole
    assert lens is not None
    gaussians, order = spec.visible_gaussians(scene, request, ray_grid(camera))
    ordered = gaussians[order]
    intrinsics = [[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]]

    def tensor(values) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, np.float32), device=device)

    colours, alphas, _ = gsplat.rasterization(
        tensor(ordered.mean_m),
        tensor(ordered.quat_wxyz),
        tensor(ordered.scale_m),
        tensor(np.minimum(ordered.opacity, spec.MAX_OPACITY)),
        tensor(ordered.rgb),
        tensor(geometry.inverse(np.asarray(request.world_from_sensor[0])))[None],
        tensor(intrinsics)[None],
        camera.width_px,
        camera.height_px,
        near_plane=0.2,
        render_mode="RGB+D",
        packed=False,
        with_ut=True,
        with_eval3d=True,
    )
    planes = torch.cat([colours[0, ..., :3], alphas[0], colours[0, ..., 3:4]], dim=-1)
    return _finished(scene, request, planes.double().cpu().numpy())


def why_gsplat_cannot_run(scene: GaussianScene, request: SensorRequest) -> str | None:
    """Render a few Gaussians with gsplat; what it says if that fails."""
    few = GaussianScene(**{**vars(scene), "static": scene.static[:GSPLAT_PROBE]})
    try:
        gsplat_frame(few, request)
    except Exception as error:
        text = " ".join(str(error).split())
        return f"{type(error).__name__}: {text[:200] or 'no text'}"
    return None


def rendering(frame_of: Callable[..., CameraFrame], scene: GaussianScene, **settings: int) -> Render:
    """One of the functions above as a back end."""

    def render(requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        return [frame_of(scene, request, **settings) for request in requests]

    return render
