"""The interface of lenses, and a base class with the common parts of most of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from jaxtyping import Bool, Float64

Points2 = Float64[np.ndarray, "n 2"]
Points3 = Float64[np.ndarray, "n 3"]
Mask = Bool[np.ndarray, " n"]


class Lens(Protocol):
    """The projection of a camera: maps the camera frame (x right, y down, z forward) to pixels and back.

    A lens is a frozen dataclass whose fields are floats, tuples of floats and enumerations. These are its parameters,
    stored in JSON, archives and messages (``register_lens``) and used as cache keys. Pixel coordinates originate at the
    corner of the image, pixel centres are at +0.5. Image size, shutter and windshield are properties of the camera
    (``types.CameraModel``), not of the lens.

    ``BaseLens`` implements everything except ``kind``, the parameters, ``project`` and ``unproject``; ``check_lens``
    tests a lens against this specification.
    """

    kind: ClassVar[str]
    """Name of this kind of lens in files: lower-case letters, digits and underscores."""
    perspective: ClassVar[bool]
    """Whether it is a perspective projection up to distortion: decides if Gaussians are sorted by z or distance."""

    def __hash__(self) -> int:
        """Hash of all parameters."""

    @property
    def cx_px(self) -> float:
        """Column at which the optical axis meets the image."""

    @property
    def cy_px(self) -> float:
        """Row at which the optical axis meets the image."""

    @property
    def fx_px(self) -> float:
        """Focal length along the rows, as defined by the lens; ``fx_px / fy_px`` is the aspect ratio."""

    @property
    def fy_px(self) -> float:
        """Focal length along the columns."""

    @property
    def max_angle_rad(self) -> float:
        """An upper bound, in (0, pi], of angles off the optical axis in the field of the lens."""

    @property
    def ideal_pinhole(self) -> Lens | None:
        """The same lens as a pinhole without distortion, which renders faster; None if it is not one."""

    def project(self, xyz: Points3) -> tuple[Points2, Mask]:
        """Pixels of points in the camera frame.

        Args:
            xyz: float64 [n,3], finite, of any magnitude; n may be 0. It is not modified.

        Returns:
            A new float64 array [n,2] of pixels, which the caller may modify, and whether each point is valid: in the
            field, where no two rays map to one pixel. Invalid pixels have arbitrary values, without warnings. Pixels
            are not limited to the image.
        """

    def unproject(self, uv: Points2) -> tuple[Points3, Mask]:
        """Unit rays of pixels: the inverse of ``project`` to 1e-6 pixels.

        Args:
            uv: float64 [n,2], finite; n may be 0. It is not modified.

        Returns:
            A new float64 array [n,3] of unit rays, and whether each pixel is in the field of the lens. Invalid rays
            have arbitrary values.
        """

    def check(self) -> None:
        """Check the parameters, which may come from a file or a request.

        Raises:
            ValueError: names the wrong parameter, its value and the allowed ones.
        """

    def scaled(self, sx: float, sy: float) -> Self:
        """The lens of the image resized by ``sx`` along the rows and ``sy`` along the columns, both positive."""

    def cropped(self, left_px: float, top_px: float) -> Self:
        """The lens of the image cropped by columns at its left and rows at its top."""

    def mirrored(self, width_px: float) -> Self:
        """The lens of the image, ``width_px`` wide, mirrored left to right, in a world with x negated."""


class BaseLens:
    """A base for lenses with the fields ``fx_px fy_px cx_px cy_px`` whose image is ``f(ray) * focal + centre``.

    ``mirrored`` holds for lenses that are symmetric from left to right; others override it.
    """

    kind: ClassVar[str]
    perspective: ClassVar[bool] = False

    @property
    def ideal_pinhole(self) -> Lens | None:
        """None: no pinhole."""
        return None

    def check(self: Any) -> None:
        """Check that all parameters are finite, focal lengths positive and the largest angle in (0, pi].

        Raises:
            ValueError: one is not.
        """
        check_values("focal length and principal point", (self.fx_px, self.fy_px, self.cx_px, self.cy_px))
        if self.fx_px <= 0 or self.fy_px <= 0:
            raise ValueError(f"focal lengths must be positive, got {self.fx_px}, {self.fy_px}")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, (int, float, tuple)):
                check_values(field.name, value if isinstance(value, tuple) else (value,))
        check_angle(self.max_angle_rad)

    def scaled(self: Any, sx: float, sy: float) -> Any:
        """Focal lengths and centre multiplied."""
        return dataclasses.replace(
            self, cx_px=self.cx_px * sx, cy_px=self.cy_px * sy, fx_px=self.fx_px * sx, fy_px=self.fy_px * sy
        )

    def cropped(self: Any, left_px: float, top_px: float) -> Any:
        """The centre moved."""
        return dataclasses.replace(self, cx_px=self.cx_px - left_px, cy_px=self.cy_px - top_px)

    def mirrored(self: Any, width_px: float) -> Any:
        """The centre moved to the other side."""
        return dataclasses.replace(self, cx_px=width_px - self.cx_px)


def missing_members(cls: type[Any]) -> list[str]:
    """Names of the members of ``Lens`` that a class has neither as a field nor as an attribute."""
    wanted = [name for name in (*Lens.__annotations__, *vars(Lens)) if not name.startswith("_")]
    return [name for name in wanted if not hasattr(cls, name) and name not in getattr(cls, "__dataclass_fields__", ())]


def check_values(what: str, values: Sequence[float], count: int | None = None) -> None:
    """Check that some parameters are finite numbers, and how many they are.

    Raises:
        ValueError: they are not.
    """
    if count is not None and len(values) != count:
        raise ValueError(f"{what} needs {count} coefficients, got {len(values)}")
    if not np.isfinite(np.asarray(values, np.float64)).all():
        raise ValueError(f"{what} must be finite, got {tuple(values)}")


def check_angle(angle_rad: float) -> None:
    """Check a ``max_angle_rad``.

    Raises:
        ValueError: it is not in (0, pi].
    """
    if not 0 < angle_rad <= np.pi:
        raise ValueError(f"max_angle_rad must lie in (0, pi], got {angle_rad}")
