"""One simulated LiDAR sweep as a file: points as NPZ or PLY, or a picture from above and by beam as PNG."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.files.new_files import write_file
from nurec_sim.logs.overlay import depth_rgb
from nurec_sim.render.device import Renderer, make_renderer
from nurec_sim.render.images.encode import encode_image
from nurec_sim.render.rays import ray_grid, world_rays
from nurec_sim.types import GaussianScene, LidarFrame, LidarModel, Matrix4, SensorRequest

SUFFIXES = (".npz", ".ply", ".png")
ROOF_M = 1.8
"""Height of a device above the rig's origin where the rig has no LiDAR whose place it could take."""
REACH_M, RINGS_M = 50.0, (10, 20, 30, 40)
"""Half the side of the view from above, and distances from the sensor at which it has circles."""
SIDE_PX = 900
PLY_VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "range")]
                      + [("row", "<i4"), ("column", "<i4"), ("after_start_us", "<i4")])  # fmt: skip


@dataclass(frozen=True)
class SweepPlace:
    """When a sweep starts, and where the car is then, relative to its recorded pose.

    Args:
        time_s: start of the sweep, in seconds after the first recorded pose.
        left_m: lateral offset of the car in metres, left positive.
        ahead_m: offset of the car along its heading in metres.
        yaw_deg: yaw offset of the car in degrees, left positive.
        standing: take the whole sweep from the pose at its start, as if the car stood.
    """

    time_s: float = 0.0
    left_m: float = 0.0
    ahead_m: float = 0.0
    yaw_deg: float = 0.0
    standing: bool = False


def choose_lidar(
    scene: GaussianScene, lidar_id: str | None = None, model: str | None = None, columns: int | None = None
) -> LidarModel:
    """A LiDAR of the scene's rig, or a device from the tables in its place.

    Args:
        scene: the world.
        lidar_id: a LiDAR of the rig; the first if None.
        model: a key of ``sensors.LIDAR_TABLES``; the rig's own LiDAR if None.
        columns: firings per sweep of the device; its own number if None.

    Raises:
        RequestError: no such LiDAR or device, or columns without a device.
    """
    rig = scene.rig.lidars
    if lidar_id is not None and lidar_id not in rig:
        raise RequestError(f"scene {scene.id!r} has no LiDAR {lidar_id!r}; have {list(rig)}")
    own = rig.get(lidar_id) if lidar_id is not None else next(iter(rig.values()), None)
    if model is None:
        if columns is not None:
            raise RequestError("--columns changes a device from the tables; name one by --model")
        if own is None:
            raise RequestError(
                f"scene {scene.id!r} has no LiDARs; name a device by --model: {', '.join(sensors.LIDAR_TABLES)}"
            )
        return own
    mount: Matrix4 = geometry.pose_from_xyyaw(0.0, 0.0, 0.0, ROOF_M) if own is None else own.rig_from_lidar
    try:
        return sensors.lidar_model(model, mount, columns=columns)
    except ValueError as error:
        raise RequestError(str(error)) from None


def sweep_request(scene: GaussianScene, lidar: LidarModel, place: SweepPlace) -> SensorRequest:
    """The request for one turn of a LiDAR on the recorded drive, or beside it.

    Raises:
        RequestError: the sweep does not lie within the recording.
    """
    turn_us = round(1e6 / lidar.frequency_hz)
    first, last = max(scene.ego.start_us, scene.span_us[0]), scene.span_us[1] - turn_us
    if not (np.isfinite(place.time_s) and first <= first + round(place.time_s * 1e6) <= last):
        raise RequestError(
            f"a sweep of {turn_us / 1e6:g} s can start 0 to {max(last - first, 0) / 1e6:g} s after the first recorded "
            f"pose, got --time-s {place.time_s:g}"
        )
    start_us = first + round(place.time_s * 1e6)
    moved = geometry.pose_from_xyyaw(place.ahead_m, place.left_m, np.radians(place.yaw_deg))
    ends = np.array([start_us, start_us if place.standing else start_us + turn_us])
    poses = scene.ego.at(ends) @ moved @ lidar.rig_from_lidar
    return SensorRequest(scene.id, lidar, start_us, start_us + turn_us, poses)


def render_sweep(
    scene: GaussianScene | Renderer,
    lidar: str | None = None,
    *,
    model: str | None = None,
    columns: int | None = None,
    time_s: float = 0.0,
    left_m: float = 0.0,
    ahead_m: float = 0.0,
    yaw_deg: float = 0.0,
    standing: bool = False,
) -> LidarFrame:
    """One turn of a LiDAR of the car, or of another device in its place, on the recorded drive or beside it.

    Args:
        scene: a scene, or its renderer (``make_renderer``), which need not be prepared again for every sweep.
        lidar: a LiDAR of the rig; the first if None.
        model: a key of ``sensors.LIDAR_TABLES``; the rig's own LiDAR if None.
        columns: firings per turn of that device; its own number if None.
        time_s: see ``SweepPlace``, as the four that follow.
        left_m: lateral offset of the car.
        ahead_m: offset of the car along its heading.
        yaw_deg: yaw offset of the car, left positive.
        standing: take the whole sweep from its first pose.

    Raises:
        RequestError: no such LiDAR or device, or the sweep does not lie within the recording.
    """
    renderer = make_renderer(scene) if isinstance(scene, GaussianScene) else scene
    place = SweepPlace(time_s, left_m, ahead_m, yaw_deg, standing)
    chosen = choose_lidar(renderer.scene, lidar, model, columns)
    return renderer.render_lidar(sweep_request(renderer.scene, chosen, place))


def write_sweep(
    renderer: Renderer, path: Path, lidar: LidarModel, place: SweepPlace, noise_m: float = 0.0, seed: int = 0
) -> LidarFrame:
    """Render a sweep and write it in the format of the path's suffix, one of ``SUFFIXES``.

    Args:
        renderer: of the world.
        path: the file to write.
        lidar: the device.
        place: when and where.
        noise_m: standard deviation of the range noise, see ``with_range_noise``.
        seed: of the noise.

    Raises:
        RequestError: the sweep does not lie within the recording.
        WriteError: the file cannot be written; one that was there is as it was.
    """
    request = sweep_request(renderer.scene, lidar, place)
    frame = with_range_noise(renderer.render_lidar(request), request, noise_m, seed)
    write = {".npz": npz_bytes, ".ply": ply_bytes, ".png": lambda *both: encode_image(sweep_picture(both[0]))}
    write_file(path, write[path.suffix.lower()](frame, request))
    return frame


def with_range_noise(frame: LidarFrame, request: SensorRequest, sigma_m: float, seed: int) -> LidarFrame:
    """A sweep whose ranges have independent Gaussian errors along their beams.

    A beam's error depends on the seed and its number alone, not on which other beams return. Returns that leave the
    device's range are dropped.

    Args:
        frame: the sweep.
        request: what it was rendered for.
        sigma_m: standard deviation of the errors; 0 changes nothing.
        seed: of the errors.
    """
    if sigma_m == 0:
        return frame
    beams = len(frame.lidar.elevation_rad) * len(frame.lidar.azimuth_rad)
    error = sigma_m * np.random.default_rng(seed).standard_normal(beams)[frame.beam]
    distance = frame.range_m + error
    kept = (distance >= frame.lidar.range_m[0]) & (distance <= frame.lidar.range_m[1])
    _, direction = world_rays(request, ray_grid(frame.lidar))
    # Points are given in the frame at the end of the sweep.
    along = direction.reshape(-1, 3)[frame.beam] @ request.world_from_sensor[1][:3, :3]
    return replace(
        frame,
        xyz_m=(frame.xyz_m + along * error[:, None])[kept].astype(np.float32),
        range_m=distance[kept].astype(np.float32),
        intensity=frame.intensity[kept],
        beam=frame.beam[kept],
    )


def firing_times(frame: LidarFrame) -> Int64[np.ndarray, " n"]:
    """When each return's beam was fired (us)."""
    fraction = sensors.column_fraction(frame.lidar)[frame.beam % len(frame.lidar.azimuth_rad)]
    return frame.start_us + np.rint(fraction * (frame.end_us - frame.start_us)).astype(np.int64)


def npz_bytes(frame: LidarFrame, request: SensorRequest) -> bytes:
    """The returns, the beam table, times and poses as an uncompressed NPZ; keys are those of the types."""
    lidar, buffer = frame.lidar, io.BytesIO()
    np.savez(
        buffer, xyz_m=frame.xyz_m, range_m=frame.range_m, intensity=frame.intensity, beam=frame.beam,
        t_us=firing_times(frame), start_us=frame.start_us, end_us=frame.end_us,
        world_from_sensor=request.world_from_sensor, elevation_rad=lidar.elevation_rad, azimuth_rad=lidar.azimuth_rad,
        row_azimuth_offset_rad=lidar.row_azimuth_offset_rad,
    )  # fmt: skip
    return buffer.getvalue()


def ply_bytes(frame: LidarFrame, request: SensorRequest) -> bytes:
    """The returns as a binary PLY that point-cloud viewers open; x, y, z in the sensor at the end of the sweep."""
    vertex = np.empty(len(frame.beam), PLY_VERTEX)
    for k, axis in enumerate("xyz"):
        vertex[axis] = frame.xyz_m[:, k]
    vertex["intensity"], vertex["range"] = frame.intensity, frame.range_m
    vertex["row"], vertex["column"] = np.divmod(frame.beam, len(frame.lidar.azimuth_rad))
    vertex["after_start_us"] = firing_times(frame) - frame.start_us
    kinds = {"f": "float", "i": "int"}
    pose = " ".join(f"{value:.9g}" for value in np.asarray(request.world_from_sensor[1]).ravel())
    header = ["ply", "format binary_little_endian 1.0", f"comment start_us {frame.start_us}",
              f"comment world_from_sensor at the end of the sweep, by rows: {pose}", f"element vertex {len(vertex)}",
              *(f"property {kinds[PLY_VERTEX[name].kind]} {name}" for name in PLY_VERTEX.names or ()),
              "end_header"]  # fmt: skip
    return ("\n".join(header) + "\n").encode() + vertex.tobytes()


def sweep_picture(frame: LidarFrame) -> UInt8[np.ndarray, "h 900 3"]:
    """A sweep from above, forwards up, and below it as an image of ranges, red near, blue far, black without return."""
    return np.concatenate([_from_above(frame), np.full((6, SIDE_PX, 3), 255, np.uint8), _by_beam(frame)])


def _from_above(frame: LidarFrame) -> UInt8[np.ndarray, "900 900 3"]:
    image = np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8)
    scale, middle = SIDE_PX / (2 * REACH_M), SIDE_PX // 2
    for radius in RINGS_M:
        cv2.circle(image, (middle, middle), round(radius * scale), (60, 60, 60), 1, cv2.LINE_AA)
    # Seen from above, higher points hide lower ones.
    order = np.argsort(frame.xyz_m[:, 2])
    across = np.floor(middle - frame.xyz_m[order, 1] * scale).astype(np.int64)
    down = np.floor(middle - frame.xyz_m[order, 0] * scale).astype(np.int64)
    inside = (across >= 0) & (across < SIDE_PX) & (down >= 0) & (down < SIDE_PX)
    image[down[inside], across[inside]] = depth_rgb(frame.range_m[order].astype(np.float64))[inside]
    for radius in RINGS_M:
        cv2.putText(image, f"{radius} m", (middle + 4, middle - round(radius * scale) - 4), cv2.FONT_HERSHEY_SIMPLEX,
                    0.4, (220, 220, 220), 1, cv2.LINE_AA)  # fmt: skip
    cv2.drawMarker(image, (middle, middle), (255, 255, 255), cv2.MARKER_TRIANGLE_UP, 9, 1)
    return image


def _by_beam(frame: LidarFrame) -> UInt8[np.ndarray, "h 900 3"]:
    rows, columns = len(frame.lidar.elevation_rad), len(frame.lidar.azimuth_rad)
    image = np.zeros((rows * columns, 3), np.uint8)
    image[frame.beam] = depth_rgb(frame.range_m.astype(np.float64))
    # Columns from left to right as one sees them: azimuths fall.
    left_first = np.argsort(-((frame.lidar.azimuth_rad + np.pi) % (2 * np.pi)), kind="stable")
    image = image.reshape(rows, columns, 3)[:, left_first]
    return cv2.resize(image, (SIDE_PX, max(128, min(2 * rows, 256))), interpolation=cv2.INTER_NEAREST)
