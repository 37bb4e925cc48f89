"""The rig and its cameras as USD: a moving Xform with one Camera per sensor.

USD cameras look along -z with y up, ours along +z with y down: ``rig_from_usd = rig_from_camera @ diag(1, -1, -1)``.
A plain USD camera has no distortion; the lens is written as the f-theta attributes that Omniverse and 3DGRUT read, and
exactly in ``nurec_sim/scene.json``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nurec_sim.scene.usd.actors import author_path
from nurec_sim.scene.usd.fields import NAMESPACE
from nurec_sim.scene.usd.layers import crate_bytes, new_stage
from nurec_sim.types import CameraModel, FTheta, GaussianScene

_APERTURE_MM = 20.955  # USD's default width; only its ratio to the focal length matters


def cameras_layer(scene: GaussianScene, fits: Mapping[str, FTheta]) -> bytes:
    """``cameras.usdc``; ``fits`` holds an f-theta fit per camera id."""
    from pxr import Tf, UsdGeom

    stage = new_stage("Rig")
    rig = UsdGeom.Xform.Get(stage, "/Rig")
    author_path(rig, scene.ego.t_us, scene.ego.world_from_body, scene.span_us[0])
    used: set[str] = set()
    for number, (camera_id, camera) in enumerate(scene.rig.cameras.items()):
        name = Tf.MakeValidIdentifier(camera_id)
        name = f"{name}_{number}" if name in used else name
        used.add(name)
        _author_camera(stage, f"/Rig/{name}", camera, fits[camera_id])
    return crate_bytes(stage)


def _author_camera(stage, path: str, camera: CameraModel, fit: FTheta) -> None:
    from pxr import Gf, Sdf, UsdGeom

    prim = UsdGeom.Camera.Define(stage, path)
    rig_from_usd = camera.rig_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    prim.AddTransformOp().Set(Gf.Matrix4d(rig_from_usd.T.tolist()))  # USD multiplies row vectors
    fx, fy, cx, cy = _pinhole_view(camera, fit)
    # USD has one focal length: the vertical aperture absorbs a ratio fx / fy other than 1.
    mm_per_px = _APERTURE_MM / camera.width_px
    prim.CreateHorizontalApertureAttr(_APERTURE_MM)
    prim.CreateVerticalApertureAttr(camera.height_px * mm_per_px * fx / fy)
    prim.CreateHorizontalApertureOffsetAttr((camera.width_px / 2 - cx) * mm_per_px)
    prim.CreateVerticalApertureOffsetAttr((cy - camera.height_px / 2) * mm_per_px * fx / fy)
    prim.CreateFocalLengthAttr(fx * mm_per_px)
    prim.CreateClippingRangeAttr(Gf.Vec2f(0.1, 10_000.0))

    types = Sdf.ValueTypeNames
    usd = prim.GetPrim()
    usd.CreateAttribute(f"{NAMESPACE}:sensorId", types.String).Set(camera.id)
    usd.CreateAttribute("cameraProjectionType", types.Token).Set("fisheyePolynomial")
    usd.CreateAttribute("fthetaWidth", types.Float).Set(float(camera.width_px))
    usd.CreateAttribute("fthetaHeight", types.Float).Set(float(camera.height_px))
    usd.CreateAttribute("fthetaCx", types.Float).Set(float(fit.cx_px))
    usd.CreateAttribute("fthetaCy", types.Float).Set(float(fit.cy_px))
    usd.CreateAttribute("fthetaMaxFov", types.Float).Set(float(np.degrees(2 * fit.max_angle_rad)))
    for letter, coefficient in zip("ABCDEF", (*fit.pixeldist_to_angle, *(0.0,) * 6)[:6], strict=True):
        usd.CreateAttribute(f"fthetaPoly{letter}", types.Float).Set(float(coefficient))


def _pinhole_view(camera: CameraModel, fit: FTheta) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) of the pinhole that agrees with the lens at its centre."""
    lens = camera.lens
    if lens.perspective:
        return lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px
    # r(theta) = a1 theta + ... has the slope a1 on the axis, as has a pinhole with that focal length.
    focal_px = fit.angle_to_pixeldist[1]
    return focal_px, focal_px, fit.cx_px, fit.cy_px
