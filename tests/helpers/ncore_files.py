"""Writes a clip as an NCore V4 sequence, with NVIDIA's own writer."""

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, logs
from nurec_sim.sensors import beam_coordinates, fill_ftheta
from nurec_sim.types import CameraModel, Fisheye, FTheta, Shutter, Spin

SHUTTERS = {Shutter.GLOBAL: "GLOBAL"} | {each: f"ROLLING_{each.name}" for each in Shutter if each != Shutter.GLOBAL}


def write_ncore(folder: Path, clip: logs.Clip, store_type: str = "itar", pose_of=np.asarray) -> Path:
    """Write the sequence, and the .json file that lists its parts, which is returned.

    Args:
        folder: where to.
        clip: what to write; sweeps are stored as they were measured, without motion compensation.
        store_type: "itar" or "directory".
        pose_of: applied to the mounting pose of every camera (the inverse is wrong on purpose).
    """
    from ncore.data import v4
    from ncore.impl.common.transformations import HalfClosedInterval
    from upath import UPath

    span = HalfClosedInterval(*clip.span_us)
    writer = v4.SequenceComponentGroupsWriter(UPath(folder), clip.id, clip.id, span, {"town": "made up"}, store_type)
    poses = writer.register_component_writer(v4.PosesComponent.Writer, "default")
    times = np.unique(np.clip([clip.span_us[0], *clip.ego.t_us, clip.span_us[1] - 1], *span_limits(clip)))
    poses.store_dynamic_pose("rig", "world", clip.ego.at(times), times.astype(np.uint64))
    intrinsics = writer.register_component_writer(v4.IntrinsicsComponent.Writer, "default")
    for name, camera in clip.rig.cameras.items():
        poses.store_static_pose(name, "rig", np.asarray(pose_of(camera.rig_from_camera), np.float64))
        intrinsics.store_camera_intrinsics(name, camera_parameters(camera))
        sensor = writer.register_component_writer(v4.CameraSensorComponent.Writer, name, name)
        for index, (start, end) in enumerate(clip.camera_times_us(name)):
            png = cv2.imencode(".png", clip.image(name, index)[:, :, ::-1])[1].tobytes()
            sensor.store_frame(png, "png", np.array([start, end], np.uint64), {}, {})
    for name, lidar in clip.rig.lidars.items():
        poses.store_static_pose(name, "rig", np.asarray(lidar.rig_from_lidar, np.float64))
        intrinsics.store_lidar_intrinsics(name, lidar_parameters(lidar))
        sensor = writer.register_component_writer(v4.LidarSensorComponent.Writer, name, name)
        for index, (start, end) in enumerate(clip.sweep_times_us(name)):
            xyz, sweep = measured(clip, name, index), clip.sweep(name, index)
            distance = np.linalg.norm(xyz, axis=1)
            # One ray in the middle of each sweep without a return.
            distance_m, intensity = (
                np.insert(np.asarray(values, np.float32), 1, np.nan)[None] for values in (distance, sweep.intensity)
            )
            rays = np.insert((xyz / distance[:, None]).astype(np.float32), 1, (1.0, 0.0, 0.0), axis=0)
            fired = np.insert(sweep.point_t_us, 1, start).astype(np.uint64)
            span = np.array([start, end], np.uint64)
            sensor.store_frame(rays, fired, None, distance_m, intensity, span, {}, {})
    store_cuboids(writer.register_component_writer(v4.CuboidsComponent.Writer, "default"), clip)
    store_masks(writer.register_component_writer(v4.MasksComponent.Writer, "default"), clip)
    paths = writer.finalize()
    meta = folder / f"{clip.id}.json"
    meta.write_text(v4.SequenceComponentGroupsReader(paths).get_sequence_meta().to_json())
    return meta


def span_limits(clip: logs.Clip) -> tuple[int, int]:
    return clip.span_us[0], clip.span_us[1] - 1


def measured(clip: logs.Clip, name: str, index: int) -> np.ndarray:
    """The points of a sweep, each in the frame of the LiDAR when it was fired."""
    sweep = clip.sweep(name, index)
    fired = clip.ego.at(sweep.point_t_us) @ clip.rig.lidars[name].rig_from_lidar
    return np.einsum("nij,nj->ni", geometry.inverse(fired)[:, :3], np.c_[sweep.xyz_world_m, np.ones(len(sweep.xyz_m))])


def camera_parameters(camera: CameraModel):
    import ncore.data as nc

    def numbers(values) -> np.ndarray:
        return np.array(values, np.float32)

    lens, glass = camera.lens, None
    if camera.windshield is not None:
        glass = nc.BivariateWindshieldModelParameters(
            nc.ReferencePolynomial[camera.windshield.reference.name],
            *(numbers(getattr(camera.windshield, key)) for key in ("horizontal", "vertical")),
            *(numbers(getattr(camera.windshield, f"{key}_inverse")) for key in ("horizontal", "vertical")),
        )
    shared = {
        "resolution": np.array([camera.width_px, camera.height_px], np.uint64),
        "shutter_type": nc.ShutterType[SHUTTERS[camera.shutter]],
        "external_distortion_parameters": glass,
    }
    if isinstance(lens, FTheta):
        full = fill_ftheta(lens, float(np.hypot(camera.width_px, camera.height_px)))
        return nc.FThetaCameraModelParameters(
            **shared,
            principal_point=numbers([lens.cx_px - 0.5, lens.cy_px - 0.5]),
            reference_poly=nc.FThetaCameraModelParameters.PolynomialType[lens.reference.name],
            pixeldist_to_angle_poly=numbers(full.pixeldist_to_angle),
            angle_to_pixeldist_poly=numbers(full.angle_to_pixeldist),
            max_angle=lens.max_angle_rad,
            linear_cde=numbers(lens.linear_cde),
        )
    shared |= {"principal_point": numbers([lens.cx_px, lens.cy_px]), "focal_length": numbers([lens.fx_px, lens.fy_px])}
    if isinstance(lens, Fisheye):
        return nc.OpenCVFisheyeCameraModelParameters(
            **shared, radial_coeffs=numbers(lens.radial), max_angle=lens.max_angle_rad
        )
    if not lens.distorted:
        return nc.IdealPinholeCameraModelParameters(**shared)
    return nc.OpenCVPinholeCameraModelParameters(
        **shared,
        radial_coeffs=numbers(lens.radial),
        tangential_coeffs=numbers(lens.tangential),
        thin_prism_coeffs=numbers(lens.thin_prism),
    )


def lidar_parameters(lidar):
    import ncore.data as nc

    # Their azimuths stay within one turn from -pi on.
    azimuth = geometry.wrap_angle(lidar.azimuth_rad).astype(np.float32)
    return nc.RowOffsetStructuredSpinningLidarModelParameters(
        spinning_frequency_hz=lidar.frequency_hz,
        spinning_direction="cw" if lidar.spin is Spin.CLOCKWISE else "ccw",
        n_rows=len(lidar.elevation_rad),
        n_columns=len(azimuth),
        row_elevations_rad=lidar.elevation_rad.astype(np.float32),
        column_azimuths_rad=azimuth,
        row_azimuth_offsets_rad=lidar.row_azimuth_offset_rad.astype(np.float32),
    )


def store_cuboids(writer, clip: logs.Clip) -> None:
    """Boxes in the frame of the rig, as it is at their time."""
    import ncore.data as nc

    found = []
    for track in clip.tracks:
        for t_us, pose in zip(track.path.t_us.tolist(), track.path.world_from_body, strict=True):
            if not span_limits(clip)[0] <= t_us <= span_limits(clip)[1]:
                continue
            local = geometry.inverse(clip.ego.at(t_us)) @ pose
            angles = Rotation.from_matrix(local[:3, :3]).as_euler("xyz")
            box = nc.BBox3(tuple(local[:3, 3].tolist()), tuple(map(float, track.size_m)), tuple(angles.tolist()))
            source = nc.LabelSource.GT_SYNTHETIC
            found.append(nc.CuboidTrackObservation(track.id, track.label, t_us, "rig", t_us, box, source))
    writer.store_observations(found)


def store_masks(writer, clip: logs.Clip) -> None:
    from PIL import Image

    for name, camera in clip.rig.cameras.items():
        mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
        mask[-2:] = 255
        writer.store_camera_masks(name, {"ego": Image.fromarray(mask)})


def beams_hit(clip: logs.Clip, name: str, index: int) -> np.ndarray:
    """Whether the points of a sweep, as measured, lie on beams of the LiDAR's model."""
    return beam_coordinates(clip.rig.lidars[name], measured(clip, name, index))[2]
