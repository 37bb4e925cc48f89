"""Rules about lenses that clients define."""

from __future__ import annotations

import math

import grpc

from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import HEIGHT_PX, Failed, Target, difference, expect
from nurec_sim.serving.wire import sensorsim

WIDTH_PX = 160
_FOCAL_PX = 80.0


def _ask(target: Target):
    """A request with intrinsics of a client's own, still without a lens."""
    request = target.request()
    request.resolution_w = WIDTH_PX
    spec = sensorsim.CameraSpec(logical_id="", resolution_h=HEIGHT_PX, resolution_w=WIDTH_PX, shutter_type=5)
    request.camera_intrinsics.CopyFrom(spec)
    return request


def _ftheta(target: Target, *, forward: bool, backward: bool):
    request = _ask(target)
    lens = request.camera_intrinsics.ftheta_param
    lens.principal_point_x, lens.principal_point_y = WIDTH_PX / 2 - 0.5, HEIGHT_PX / 2 - 0.5
    lens.reference_poly = 2 if forward else 1
    lens.angle_to_pixeldist_poly.extend([0.0, _FOCAL_PX] if forward else [])
    lens.pixeldist_to_angle_poly.extend([0.0, 1 / _FOCAL_PX] if backward else [])
    lens.max_angle = 1.3
    lens.linear_cde.linear_c = 1.0
    return request


def _fill_opencv(lens) -> None:
    lens.principal_point_x, lens.principal_point_y = WIDTH_PX / 2, HEIGHT_PX / 2
    lens.focal_length_x = lens.focal_length_y = _FOCAL_PX


@check("lens-pinhole")
def pinhole(target: Target) -> str:
    """A client may send an OpenCV pinhole of its own."""
    request = _ask(target)
    _fill_opencv(request.camera_intrinsics.opencv_pinhole_param)
    image = target.picture(request)
    expect(image.shape[:2] == (HEIGHT_PX, WIDTH_PX), f"{WIDTH_PX}x{HEIGHT_PX} was asked, got {image.shape[1::-1]}")
    return f"{image.shape[1]}x{image.shape[0]}"


@check("lens-fisheye")
def fisheye(target: Target) -> str:
    """An OpenCV fisheye without distortion shows the same as an F-theta with r = f * angle."""
    request = _ask(target)
    lens = request.camera_intrinsics.opencv_fisheye_param
    _fill_opencv(lens)
    lens.max_angle = 1.3
    gap = difference(target.picture(request), target.picture(_ftheta(target, forward=True, backward=True)))
    expect(gap < 2, f"the two differ by {gap:.1f} steps; is a principal point half a pixel off?")
    return f"{gap:.2f} steps apart"


@check("lens-ftheta-one-polynomial")
def one_polynomial(target: Target) -> str:
    """An F-theta lens with only one of its polynomials is enough, whichever it is."""
    both = target.picture(_ftheta(target, forward=True, backward=True))
    for name, forward in (("angle_to_pixeldist_poly", True), ("pixeldist_to_angle_poly", False)):
        try:
            alone = target.picture(_ftheta(target, forward=forward, backward=not forward))
        except grpc.RpcError as error:
            raise Failed(f"with only {name} it was refused with {error.code().name}: {error.details()}") from error
        gap = difference(alone, both)
        expect(gap < 1, f"with only {name} the picture differs by {gap:.1f} steps")
    return "either one gives the same picture"


@check("lens-windshield")
def windshield(target: Target) -> str:
    """A windshield that bends nothing changes nothing, one that shifts every ray does."""
    plain = target.picture(_ftheta(target, forward=True, backward=True))

    def behind_glass(shift: float):
        request = _ftheta(target, forward=True, backward=True)
        glass = request.camera_intrinsics.bivariate_windshield_model_param
        for poly, sign in ((glass.horizontal_poly, 1), (glass.horizontal_poly_inverse, -1)):
            poly.extend([sign * shift, 1.0, 0.0])
        for poly in (glass.vertical_poly, glass.vertical_poly_inverse):
            poly.extend([0.0, 0.0, 1.0])
        return target.picture(request)

    clear, bent = difference(behind_glass(0.0), plain), difference(behind_glass(math.radians(3)), plain)
    expect(clear < 1, f"clear glass changes the picture by {clear:.1f} steps")
    expect(bent > clear, "glass that turns every ray by 3 degrees changes nothing")
    return f"{clear:.2f} steps through clear glass, {bent:.1f} through bent glass"


@check("lens-missing")
def lens_missing(target: Target) -> str:
    """Intrinsics without lens parameters, of a camera that nobody knows, are INVALID_ARGUMENT."""
    return target.refused("render_rgb", _ask(target), grpc.StatusCode.INVALID_ARGUMENT)
