"""Cameras and LiDARs of NCore as ours; parameters are read from the objects that the package ``ncore.data`` gives.

Their conventions: principal points of F-theta lenses count pixel centres as whole numbers, those of the other lenses
from the corner of the image; angles of LiDARs are float32, azimuths may jump by a turn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from nurec_sim import sensors
from nurec_sim.errors import ClipError
from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Lens, Pinhole
from nurec_sim.logs import calibration
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Shutter, Spin, Windshield, WindshieldReference

_SHUTTERS = {
    "ROLLING_TOP_TO_BOTTOM": Shutter.TOP_TO_BOTTOM,
    "ROLLING_LEFT_TO_RIGHT": Shutter.LEFT_TO_RIGHT,
    "ROLLING_BOTTOM_TO_TOP": Shutter.BOTTOM_TO_TOP,
    "ROLLING_RIGHT_TO_LEFT": Shutter.RIGHT_TO_LEFT,
    "GLOBAL": Shutter.GLOBAL,
}


def camera_model(id: str, parameters: Any, rig_from_camera: Matrix4) -> CameraModel:
    """A camera from ``CameraModelParameters`` of NCore.

    Raises:
        ClipError: its model or its windshield is of an unknown kind, or a parameter is wrong.
    """
    kind = parameters.type()
    if kind not in _LENSES:
        raise ClipError(f"camera {id!r}: camera model {kind!r} is unknown; known are {sorted(_LENSES)}")
    width, height = (int(value) for value in parameters.resolution)
    return calibration.checked_camera(
        CameraModel(
            id=id,
            width_px=width,
            height_px=height,
            lens=_LENSES[kind](parameters),
            rig_from_camera=rig_from_camera,
            shutter=_SHUTTERS[parameters.shutter_type.name],
            windshield=_windshield(id, parameters.external_distortion_parameters),
        )
    )


def _numbers(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _polynomial(values: Any) -> tuple[float, ...]:
    """Coefficients without the zeros that pad them; none for a polynomial that is not given."""
    return _numbers(np.trim_zeros(np.asarray(values), "b"))


def _ftheta(parameters: Any) -> FTheta:
    c, d, e = _numbers(parameters.linear_cde)
    return FTheta(
        cx_px=float(parameters.principal_point[0]) + 0.5,
        cy_px=float(parameters.principal_point[1]) + 0.5,
        reference=FThetaReference(parameters.reference_poly.name.lower()),
        pixeldist_to_angle=_polynomial(parameters.pixeldist_to_angle_poly),
        angle_to_pixeldist=_polynomial(parameters.angle_to_pixeldist_poly),
        max_angle_rad=float(parameters.max_angle),
        linear_cde=(c, d, e),
    )


def _focal_and_principal(parameters: Any) -> tuple[float, float, float, float]:
    (fx, fy), (cx, cy) = _numbers(parameters.focal_length), _numbers(parameters.principal_point)
    return fx, fy, cx, cy


def _ideal_pinhole(parameters: Any) -> Pinhole:
    fx, fy, cx, cy = _focal_and_principal(parameters)
    return Pinhole(fx, fy, cx, cy)


def _pinhole(parameters: Any) -> Pinhole:
    fx, fy, cx, cy = _focal_and_principal(parameters)
    distortion = (parameters.radial_coeffs, parameters.tangential_coeffs, parameters.thin_prism_coeffs)
    radial, tangential, thin_prism = (_numbers(each) for each in distortion)
    return Pinhole(fx, fy, cx, cy, radial, tangential, thin_prism)


def _fisheye(parameters: Any) -> Fisheye:
    fx, fy, cx, cy = _focal_and_principal(parameters)
    return Fisheye(fx, fy, cx, cy, _numbers(parameters.radial_coeffs), float(parameters.max_angle))


_LENSES: dict[str, Callable[[Any], Lens]] = {
    "ftheta": _ftheta,
    "ideal-pinhole": _ideal_pinhole,
    "opencv-pinhole": _pinhole,
    "opencv-fisheye": _fisheye,
}


def _windshield(id: str, parameters: Any) -> Windshield | None:
    if parameters is None:
        return None
    if parameters.type() != "bivariate-windshield":
        raise ClipError(f"camera {id!r}: distortion {parameters.type()!r} is unknown; known is 'bivariate-windshield'")
    return Windshield(
        reference=WindshieldReference(parameters.reference_poly.name.lower()),
        horizontal=_numbers(parameters.horizontal_poly),
        vertical=_numbers(parameters.vertical_poly),
        horizontal_inverse=_numbers(parameters.horizontal_poly_inverse),
        vertical_inverse=_numbers(parameters.vertical_poly_inverse),
    )


def lidar_model(id: str, parameters: Any, rig_from_lidar: Matrix4) -> tuple[LidarModel, str]:
    """A LiDAR from ``LidarModelParameters`` of NCore, and a note on where its beams are from.

    A log may have no table of beams; that of a common device stands in, for rendering.

    Raises:
        ClipError: the model is of an unknown kind, or a parameter is wrong.
    """
    if parameters is None:
        lidar = sensors.lidar_model(sensors.STAND_IN_TABLE, rig_from_lidar, id=id)
        return lidar, f"no table of its beams is given; {sensors.STAND_IN_TABLE} stands in"
    if parameters.type() != "row-offset-spinning":
        raise ClipError(f"LiDAR {id!r}: model {parameters.type()!r} is unknown; known is 'row-offset-spinning'")
    lidar = LidarModel(
        id=id,
        elevation_rad=np.asarray(parameters.row_elevations_rad, np.float64),
        azimuth_rad=np.unwrap(np.asarray(parameters.column_azimuths_rad, np.float64)),
        row_azimuth_offset_rad=np.asarray(parameters.row_azimuth_offsets_rad, np.float64),
        rig_from_lidar=rig_from_lidar,
        spin=Spin.CLOCKWISE if parameters.spinning_direction == "cw" else Spin.COUNTERCLOCKWISE,
        frequency_hz=float(parameters.spinning_frequency_hz),
    )
    try:
        sensors.check_lidar(lidar)
    except ValueError as error:
        raise ClipError(str(error)) from None
    return lidar, "as given by the log"
