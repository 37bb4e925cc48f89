"""Cameras and LiDARs from ``rig_trajectories.json``, the counterpart of what ``scene.sidecars`` writes.

Conventions there: ``T_sensor_rig`` takes sensor coordinates to the rig's; f-theta principal points count pixel centres
as whole numbers, ours lie half a pixel further; a pinhole's and a fisheye's are ours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from nurec_sim import sensors
from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Lens, Pinhole
from nurec_sim.scene import codec
from nurec_sim.scene.sidecars import SHUTTER_NAMES
from nurec_sim.types import CameraModel, LidarModel, Spin, Windshield, WindshieldReference

_SHUTTERS = {name: shutter for shutter, name in SHUTTER_NAMES.items()}
_MATRIX = codec.array(np.float64, 4, 4)


def camera_from(calibration: Mapping[str, Any], name: str) -> CameraModel:
    """A camera from an entry of ``camera_calibrations``; our own files' exact lens is taken where they have one.

    Raises:
        ValueError: a value is missing, of the wrong kind, or makes no camera; a lens of another kind.
    """
    model = calibration.get("exact_camera_model") or calibration.get("camera_model")
    kind, parameters = _model(model)
    lens = _lens(kind, parameters)
    size = codec.sequence(codec.integer)(_get(parameters, "resolution"))
    if len(size) != 2:
        raise ValueError(f"resolution must be [width, height], got {size}")
    shutter = parameters.get("shutter_type", "GLOBAL")
    if shutter not in _SHUTTERS:
        raise ValueError(f"shutter_type {shutter!r:.60} is not known; known are {sorted(_SHUTTERS)}")
    camera = CameraModel(
        name, size[0], size[1], lens, _MATRIX(_get(calibration, "T_sensor_rig")),
        _SHUTTERS[shutter], _windshield(parameters.get("external_distortion_parameters")),
    )  # fmt: skip
    sensors.check_camera(camera)
    return camera


def lidar_from(calibration: Mapping[str, Any], name: str) -> LidarModel:
    """A LiDAR from an entry of ``lidar_calibrations``.

    Raises:
        ValueError: a value is missing, of the wrong kind, or makes no LiDAR; a LiDAR of another kind.
    """
    kind, parameters = _model(calibration.get("lidar_model"))
    if kind != "row-offset-spinning":
        raise ValueError(f"LiDAR model {kind!r:.60} is not known; known is 'row-offset-spinning'")
    angles = codec.array(np.float64, -1)
    elevation = angles(_get(parameters, "row_elevations_rad"))
    lidar = LidarModel(
        id=name,
        elevation_rad=elevation,
        azimuth_rad=angles(_get(parameters, "column_azimuths_rad")),
        row_azimuth_offset_rad=angles(parameters.get("row_azimuth_offsets_rad", [0.0] * len(elevation))),
        rig_from_lidar=_MATRIX(_get(calibration, "T_sensor_rig")),
        spin=Spin(parameters.get("spinning_direction", Spin.CLOCKWISE.value)),
        frequency_hz=codec.number(parameters.get("spinning_frequency_hz", 10.0)),
    )
    sensors.check_lidar(lidar)
    return lidar


def _model(model: object) -> tuple[str, Mapping[str, Any]]:
    if not isinstance(model, Mapping) or not isinstance(model.get("parameters"), Mapping):
        raise ValueError(f"a model with 'type' and 'parameters' is needed, got {model!r:.60}")
    return codec.text(model.get("type")), model["parameters"]


def _get(parameters: Mapping[str, Any], name: str) -> Any:
    if name not in parameters:
        raise ValueError(f"{name!r} is missing; have {sorted(map(str, parameters))[:20]}")
    return parameters[name]


def _lens(kind: str, parameters: Mapping[str, Any]) -> Lens:
    """Lenses that NCore does not know have their parameters as ``nurec_sim/scene.json`` has them."""
    if kind in _LENSES:
        return _LENSES[kind](parameters)
    if "lens" not in parameters:
        raise ValueError(f"camera model {kind!r:.60} is not known; known are {sorted(_LENSES)}")
    return codec.lens(parameters["lens"])


def _pair(parameters: Mapping[str, Any], name: str) -> tuple[float, float]:
    x, y = codec.numbers(2)(_get(parameters, name))
    return x, y


def _ftheta(parameters: Mapping[str, Any]) -> FTheta:
    cx, cy = _pair(parameters, "principal_point")
    reference = codec.text(_get(parameters, "reference_poly"))
    if reference not in FThetaReference.__members__:
        raise ValueError(f"reference_poly {reference!r:.60}; known are {list(FThetaReference.__members__)}")
    c, d, e = codec.numbers(3)(parameters.get("linear_cde", [1.0, 0.0, 0.0]))
    return FTheta(
        cx_px=cx + 0.5,
        cy_px=cy + 0.5,
        reference=FThetaReference[reference],
        pixeldist_to_angle=_polynomial(parameters, "pixeldist_to_angle_poly"),
        angle_to_pixeldist=_polynomial(parameters, "angle_to_pixeldist_poly"),
        max_angle_rad=min(codec.number(_get(parameters, "max_angle")), np.pi),
        linear_cde=(c, d, e),
    )


def _polynomial(parameters: Mapping[str, Any], name: str) -> tuple[float, ...]:
    """Coefficients without the zeros that fill a list up to its usual length; none if all are zero."""
    values = list(codec.numbers()(parameters.get(name) or []))
    while values and values[-1] == 0:
        values.pop()
    return tuple(values)


def _pinhole(parameters: Mapping[str, Any]) -> Pinhole:
    return Pinhole(
        *_pair(parameters, "focal_length"),
        *_pair(parameters, "principal_point"),
        radial=_filled(parameters, "radial_coeffs", 6),
        tangential=_filled(parameters, "tangential_coeffs", 2),
        thin_prism=_filled(parameters, "thin_prism_coeffs", 4),
    )


def _fisheye(parameters: Mapping[str, Any]) -> Fisheye:
    return Fisheye(
        *_pair(parameters, "focal_length"),
        *_pair(parameters, "principal_point"),
        radial=_filled(parameters, "radial_coeffs", 4),
        max_angle_rad=min(codec.number(parameters.get("max_angle", np.pi / 2)), np.pi),
    )


def _filled(parameters: Mapping[str, Any], name: str, count: int) -> tuple[float, ...]:
    values = codec.numbers()(parameters.get(name) or [])
    if len(values) > count:
        raise ValueError(f"{name} has {len(values)} coefficients; at most {count} are known")
    return values + (0.0,) * (count - len(values))


_LENSES: dict[str, Callable[[Mapping[str, Any]], Lens]] = {
    "ftheta": _ftheta,
    "opencv-pinhole": _pinhole,
    "opencv-fisheye": _fisheye,
}


def _windshield(parameters: object) -> Windshield | None:
    if parameters is None:
        return None
    if not isinstance(parameters, Mapping) or parameters.get("type", "bivariate-windshield") != "bivariate-windshield":
        raise ValueError(f"external distortion {parameters!r:.60} is not known; known is 'bivariate-windshield'")
    reference = codec.text(_get(parameters, "reference_poly"))
    if reference not in WindshieldReference.__members__:
        known = list(WindshieldReference.__members__)
        raise ValueError(f"the windshield's reference_poly {reference!r:.60} is not known; known are {known}")
    names = ("horizontal_poly", "vertical_poly", "horizontal_poly_inverse", "vertical_poly_inverse")
    return Windshield(WindshieldReference[reference], *(codec.numbers()(parameters.get(name) or []) for name in names))
