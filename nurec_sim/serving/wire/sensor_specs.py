"""Cameras and LiDARs <-> messages.

F-theta principal points on the wire count pixel centres as whole numbers (as in ncore and NuRec archives), ours count
from the image corner, so 0.5 is added on reading and taken off on writing. Pinhole and fisheye have corner origin on
both sides.
"""

from __future__ import annotations

import enum
import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from nurec_sim.errors import RequestError
from nurec_sim.files.decoding import json_value
from nurec_sim.lenses import (
    Fisheye,
    FTheta,
    FThetaReference,
    Lens,
    Pinhole,
    decode_parameters,
    encode_parameters,
    lens_class,
)
from nurec_sim.sensors import check_camera, check_lidar, fit_ftheta, lidar_model, scaled_camera
from nurec_sim.serving.wire.messages import (
    CustomSpin,
    FthetaPolynomial,
    LidarDeviceType,
    ShutterType,
    WindshieldPolynomial,
)
from nurec_sim.types import CameraModel, LidarModel, Shutter, Spin, Windshield, WindshieldReference

MAX_COEFFICIENTS = 64
"""Of one polynomial; cameras in use have 6, windshields up to 21, and the time to solve one grows with its cube."""

MAX_PARAMETERS = 1 << 16
"""Characters of the parameters of a custom lens."""

_SHUTTER_TYPE = {
    Shutter.GLOBAL: ShutterType.GLOBAL,
    Shutter.TOP_TO_BOTTOM: ShutterType.ROLLING_TOP_TO_BOTTOM,
    Shutter.LEFT_TO_RIGHT: ShutterType.ROLLING_LEFT_TO_RIGHT,
    Shutter.BOTTOM_TO_TOP: ShutterType.ROLLING_BOTTOM_TO_TOP,
    Shutter.RIGHT_TO_LEFT: ShutterType.ROLLING_RIGHT_TO_LEFT,
}
_SHUTTER = {number: shutter for shutter, number in _SHUTTER_TYPE.items()} | {ShutterType.UNKNOWN: Shutter.GLOBAL}


# ------------------------------------------------------------------------------------------------------------- cameras


def write_camera(camera: CameraModel, message) -> None:
    """Fills a ``CameraSpec`` message.

    Raises:
        ValueError: a lens for which the message has no fields of its own sees nothing in the image.
    """
    message.logical_id = camera.id
    message.resolution_w, message.resolution_h = camera.width_px, camera.height_px
    message.shutter_type = _SHUTTER_TYPE[camera.shutter]
    if camera.lens.kind in _LENS_WRITERS:
        _LENS_WRITERS[camera.lens.kind](camera.lens, message)
    else:
        _write_ftheta(fit_ftheta(camera), message)  # for programs that do not know the lens
        message.custom_lens.kind = camera.lens.kind
        message.custom_lens.parameters = json.dumps(encode_parameters(camera.lens))
    if camera.windshield is not None:
        glass = message.bivariate_windshield_model_param
        glass.SetInParent()
        glass.reference_poly = WindshieldPolynomial[camera.windshield.reference.name]
        glass.horizontal_poly.extend(camera.windshield.horizontal)
        glass.vertical_poly.extend(camera.windshield.vertical)
        glass.horizontal_poly_inverse.extend(camera.windshield.horizontal_inverse)
        glass.vertical_poly_inverse.extend(camera.windshield.vertical_inverse)


def _write_ftheta(lens: FTheta, message) -> None:
    param = message.ftheta_param
    param.principal_point_x, param.principal_point_y = lens.cx_px - 0.5, lens.cy_px - 0.5
    param.reference_poly = FthetaPolynomial[lens.reference.name]
    param.pixeldist_to_angle_poly.extend(lens.pixeldist_to_angle)
    param.angle_to_pixeldist_poly.extend(lens.angle_to_pixeldist)
    param.max_angle = lens.max_angle_rad
    param.linear_cde.linear_c, param.linear_cde.linear_d, param.linear_cde.linear_e = lens.linear_cde


def _write_pinhole(lens: Pinhole, message) -> None:
    _write_opencv(lens, message.opencv_pinhole_param)
    message.opencv_pinhole_param.tangential_coeffs.extend(lens.tangential)
    message.opencv_pinhole_param.thin_prism_coeffs.extend(lens.thin_prism)


def _write_fisheye(lens: Fisheye, message) -> None:
    _write_opencv(lens, message.opencv_fisheye_param)
    message.opencv_fisheye_param.max_angle = lens.max_angle_rad


def _write_opencv(lens: Pinhole | Fisheye, param) -> None:
    param.principal_point_x, param.principal_point_y = lens.cx_px, lens.cy_px
    param.focal_length_x, param.focal_length_y = lens.fx_px, lens.fy_px
    param.radial_coeffs.extend(lens.radial)


_LENS_WRITERS: dict[str, Callable[[Any, Any], None]] = {
    Pinhole.kind: _write_pinhole,
    Fisheye.kind: _write_fisheye,
    FTheta.kind: _write_ftheta,
}


def read_camera(message: Any, width_px: int, height_px: int, known: Mapping[str, CameraModel]) -> CameraModel:
    """The camera that a ``CameraSpec`` message describes, scaled to the requested size with its field of view kept.

    A message without lens parameters names one of the scene's ``known`` cameras by ``logical_id``. A requested width of
    0 or 1 follows from the height and the native aspect ratio, and the other way round.

    Args:
        message: the ``CameraSpec``.
        width_px: requested width.
        height_px: requested height.
        known: the scene's cameras by id.

    Raises:
        RequestError: no lens and no known camera of that id, or the parameters make no camera.
    """
    kind = "custom_lens" if message.HasField("custom_lens") else message.WhichOneof("camera_param")
    if kind is None:
        native = known.get(message.logical_id)
        if native is None:
            raise RequestError(
                "camera_intrinsics must hold ftheta_param, opencv_pinhole_param or opencv_fisheye_param, or a "
                f"logical_id of the scene; got no parameters and logical_id {message.logical_id!r}, "
                f"the scene has {sorted(known)}"
            )
    else:
        native = CameraModel(
            message.logical_id,
            message.resolution_w or width_px,
            message.resolution_h or height_px,
            _read_lens(message, kind),
            np.eye(4),
            _SHUTTER[_member(ShutterType, message.shutter_type, "shutter_type")],
            _read_windshield(message),
        )
    if native.width_px < 1 or native.height_px < 1:
        raise RequestError(
            "the image size is missing: camera_intrinsics has resolution "
            f"{message.resolution_w}x{message.resolution_h}, the request {width_px}x{height_px}"
        )
    try:
        check_camera(native)
        width_px, height_px = _image_size(native, width_px, height_px)
        if (width_px, height_px) == (native.width_px, native.height_px):
            return native
        camera = scaled_camera(native, width_px, height_px)
        check_camera(camera)  # strange numbers may have overflowed
    except (ValueError, ArithmeticError) as error:  # Python's own floats raise where NumPy's become infinite
        raise RequestError(f"camera_intrinsics: {error}") from error
    return camera


def _image_size(native: CameraModel, width_px: int, height_px: int) -> tuple[int, int]:
    if width_px <= 1 and height_px <= 1:
        return native.width_px, native.height_px
    if width_px <= 1:
        return max(1, height_px * native.width_px // native.height_px), height_px
    if height_px <= 1:
        return width_px, max(1, width_px * native.height_px // native.width_px)
    return width_px, height_px


def _read_lens(message, kind: str) -> Lens:
    param = getattr(message, kind)
    if kind == "custom_lens":
        return _read_custom_lens(param)
    if kind == "ftheta_param":
        forward = _bounded(param.angle_to_pixeldist_poly, "angle_to_pixeldist_poly")
        backward = _bounded(param.pixeldist_to_angle_poly, "pixeldist_to_angle_poly")
        exact = FThetaReference.PIXELDIST_TO_ANGLE if backward else FThetaReference.ANGLE_TO_PIXELDIST
        if param.reference_poly != FthetaPolynomial.UNKNOWN:
            exact = FThetaReference[_member(FthetaPolynomial, param.reference_poly, "reference_poly").name]
        linear = (param.linear_cde.linear_c, param.linear_cde.linear_d, param.linear_cde.linear_e)
        return FTheta(
            param.principal_point_x + 0.5,
            param.principal_point_y + 0.5,
            exact,
            backward,
            forward,
            param.max_angle or np.pi / 2,
            linear if any(linear) else (1.0, 0.0, 0.0),
        )
    lens = (param.focal_length_x, param.focal_length_y, param.principal_point_x, param.principal_point_y)
    if kind == "opencv_fisheye_param":
        return Fisheye(*lens, _padded(param.radial_coeffs, 4, "radial_coeffs"), param.max_angle or np.pi / 2)
    return Pinhole(
        *lens,
        _padded(param.radial_coeffs, 6, "radial_coeffs"),
        _padded(param.tangential_coeffs, 2, "tangential_coeffs"),
        _padded(param.thin_prism_coeffs, 4, "thin_prism_coeffs"),
    )


def _read_custom_lens(param) -> Lens:
    try:
        if len(param.parameters) > MAX_PARAMETERS:
            raise ValueError(f"parameters may have {MAX_PARAMETERS} characters, got {len(param.parameters)}")
        return decode_parameters(lens_class(param.kind), json_value(param.parameters.encode()))
    except (ValueError, RecursionError) as error:
        raise RequestError(f"camera_intrinsics: custom_lens: {error}") from error


def _bounded(values, name: str) -> tuple[float, ...]:
    if len(values) > MAX_COEFFICIENTS:
        raise RequestError(
            f"camera_intrinsics: {name} has {len(values)} values, at most {MAX_COEFFICIENTS} are allowed"
        )
    return tuple(values)


def _padded(values, count: int, name: str) -> tuple[float, ...]:
    if len(values) > count:
        raise RequestError(f"camera_intrinsics: {name} has {len(values)} values, at most {count} are allowed")
    return (*values, *(0.0,) * (count - len(values)))


def _read_windshield(message) -> Windshield | None:
    if message.WhichOneof("external_distortion") is None:
        return None
    glass = message.bivariate_windshield_model_param
    return Windshield(
        WindshieldReference[_member(WindshieldPolynomial, glass.reference_poly, "reference_poly").name],
        _bounded(glass.horizontal_poly, "horizontal_poly"),
        _bounded(glass.vertical_poly, "vertical_poly"),
        _bounded(glass.horizontal_poly_inverse, "horizontal_poly_inverse"),
        _bounded(glass.vertical_poly_inverse, "vertical_poly_inverse"),
    )


# -------------------------------------------------------------------------------------------------------------- LiDARs


def write_lidar(lidar: LidarModel, message) -> None:
    """Fills a ``LidarSpec`` message; always as a custom model, which is exact."""
    model = message.custom_model
    model.name = lidar.id
    model.elevation_rad.extend(np.asarray(lidar.elevation_rad, np.float64).tolist())
    model.azimuth_rad.extend(np.asarray(lidar.azimuth_rad, np.float64).tolist())
    model.row_azimuth_offset_rad.extend(np.asarray(lidar.row_azimuth_offset_rad, np.float64).tolist())
    model.spin = CustomSpin[lidar.spin.name]
    model.frequency_hz = lidar.frequency_hz
    model.min_range_m, model.max_range_m = lidar.range_m
    model.blocked.extend(lidar.blocked.tolist())


def read_lidar(message) -> LidarModel:
    """The LiDAR of a ``LidarSpec`` message: its custom model, else the named device.

    Raises:
        RequestError: an unknown device, or a custom model that ``sensors.check_lidar`` refuses.
    """
    if not message.HasField("custom_model"):
        return lidar_model(_member(LidarDeviceType, message.lidar_type, "lidar_type").name, np.eye(4))
    model = message.custom_model
    lidar = LidarModel(
        model.name,
        np.array(model.elevation_rad, np.float64),
        np.array(model.azimuth_rad, np.float64),
        np.array(model.row_azimuth_offset_rad or [0.0] * len(model.elevation_rad), np.float64),
        np.eye(4),
        Spin[_member(CustomSpin, model.spin, "spin").name],
        model.frequency_hz or 10.0,
        (model.min_range_m, model.max_range_m or 200.0),
        np.array(model.blocked, np.int64),
    )
    try:
        check_lidar(lidar)
    except ValueError as error:
        raise RequestError(f"custom_model: {error}") from error
    return lidar


def _member(kind: Any, number: int, name: str) -> enum.IntEnum:
    if number not in list(kind):
        raise RequestError(f"{name} must be one of {[member.name for member in kind]}, got {number}")
    return kind(number)
