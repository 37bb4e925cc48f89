"""What a lens must offer, and a base class with what most lenses have in common."""

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
    """Where a camera sees a point: the map from the camera frame (x right, y down, z forward) to pixels and back.

    A lens is a frozen dataclass whose fields are floats, tuples of floats and enumerations. They are its parameters:
    what JSON, archives and messages hold (``register_lens``), and what caches are keyed by. Pixels have their origin
    at the corner of the image, centres at +0.5. A lens knows nothing of the size of the image, the shutter and the
    windshield; those are the camera's (``types.CameraModel``).

    ``BaseLens`` brings everything but ``kind``, the numbers, ``project`` and ``unproject``; ``check_lens`` tests a
    lens against this text.
    """

    kind: ClassVar[str]
    """Name of this kind of lens in files: lower-case letters, digits and underscores."""
    perspective: ClassVar[bool]
    """Whether lines stay lines, up to a distortion: then Gaussians are sorted by z, otherwise by distance."""

    def __hash__(self) -> int:
        """Of all parameters."""

    @property
    def cx_px(self) -> float:
        """Column at which the optical axis meets the image."""

    @property
    def cy_px(self) -> float:
        """Row at which the optical axis meets the image."""

    @property
    def fx_px(self) -> float:
        """Focal length along the rows; how it is defined is up to the lens, ``fx_px / fy_px`` stretches the image."""

    @property
    def fy_px(self) -> float:
        """Focal length along the columns."""

    @property
    def max_angle_rad(self) -> float:
        """An angle off the optical axis, in (0, pi], beyond which the lens sees nothing."""

    @property
    def ideal_pinhole(self) -> Lens | None:
        """The same lens as a pinhole without distortion, or None where it is not one: renderers are faster then."""

    def project(self, xyz: Points3) -> tuple[Points2, Mask]:
        """Pixels of points in the camera frame.

        Args:
            xyz: float64 [n,3], finite, of any length; n may be 0. It is not written to.

        Returns:
            A new float64 array [n,2] of pixels, which the caller may write to, and whether each point is valid: in
            the field, where no two rays meet in one pixel. Pixels that are not valid are anything, and no warning.
            The image has no border here.
        """

    def unproject(self, uv: Points2) -> tuple[Points3, Mask]:
        """Unit rays of pixels: the inverse of ``project`` to 1e-6 pixels.

        Args:
            uv: float64 [n,2], finite; n may be 0. It is not written to.

        Returns:
            A new float64 array [n,3] of unit rays, and whether the lens sees anything at each pixel. Rays that are
            not valid are anything.
        """

    def check(self) -> None:
        """Check the parameters, which may come from a file or a request.

        Raises:
            ValueError: which one is wrong, what it is and what is allowed.
        """

    def scaled(self, sx: float, sy: float) -> Self:
        """The lens of the image resized by ``sx`` along the rows and ``sy`` along the columns, both positive."""

    def cropped(self, left_px: float, top_px: float) -> Self:
        """The lens of the image after cutting off columns at its left and rows at its top."""

    def mirrored(self, width_px: float) -> Self:
        """The lens of the image, ``width_px`` wide, with left and right swapped, in a world with x negated."""


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
