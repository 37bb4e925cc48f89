"""The tables of one segment of Waymo's Perception data set v2: one Parquet file for each component."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS

if TYPE_CHECKING:
    import polars

TIME, CAMERA, LASER, OBJECT = (
    f"key.{name}" for name in ("frame_timestamp_micros", "camera_name", "laser_name", "laser_object_id")
)
ROW = "row"
# Folders, and what the names of their columns begin with.
COMPONENTS = {
    "vehicle_pose": "VehiclePose",
    "camera_calibration": "CameraCalibration",
    "camera_image": "CameraImage",
    "lidar_calibration": "LiDARCalibration",
    "lidar": "LiDAR",
    "lidar_pose": "LiDARPose",
    "lidar_box": "LiDARBox",
}


@dataclass(frozen=True)
class Tables:
    """The tables of a segment, read row by row where rows are large.

    Attributes:
        folder: with a folder for each component.
        segment: the name of the segment, which its files have.
    """

    folder: Path
    segment: str

    def has(self, component: str) -> bool:
        """Whether there is a file of a component."""
        return self._file(component).is_file()

    def table(self, component: str, keys: Sequence[str], columns: Sequence[str]) -> polars.DataFrame:
        """All rows of some columns, with the number of each row in the column ``row``.

        Args:
            component: name of its folder.
            keys: full names.
            columns: names without that of the component.

        Raises:
            ClipError: the file or a column is missing, an entry is empty, or the file is damaged or too large.
        """
        return self._read(component, keys, columns, None)

    def row(self, component: str, index: int, columns: Sequence[str]) -> polars.DataFrame:
        """One row of some columns; arguments and errors as for ``table``."""
        return self._read(component, (), columns, index)

    def _read(self, component: str, keys: Sequence[str], columns: Sequence[str], index: int | None) -> polars.DataFrame:
        import polars

        if not self.has(component):
            raise ClipError(f"{self._name(component)} is missing")
        prefix = f"[{COMPONENTS[component]}Component]."
        with self._damage(component):
            lazy = polars.scan_parquet(self._file(component))
            known = lazy.collect_schema().names()
            for name in [*keys, *(prefix + name for name in columns)]:
                if name not in known:
                    raise ClipError(f"{self._name(component)}: column {name!r} is missing; have {known}")
            rows = lazy.select(polars.len()).collect().item()
            if rows > LIMITS.table_rows:
                raise ClipError(f"{self._name(component)} has {rows:,} rows; {LIMITS.table_rows:,} are read")
            lazy = lazy.select(*keys, *(polars.col(prefix + name).alias(name) for name in columns))
            table = (lazy if index is None else lazy.slice(index, 1)).with_row_index(ROW).collect()
        for name, empty in zip(table.columns, table.null_count().row(0), strict=True):
            if empty:
                raise ClipError(f"{self._name(component)}: column {name!r} has empty entries")
        return table

    def inclinations(self, index: int) -> Float64[np.ndarray, " k"]:
        """The beam inclinations of a LiDAR by its row; empty if its rows are equal."""
        import polars

        name = "[LiDARCalibrationComponent].beam_inclination.values"
        with self._damage("lidar_calibration"):
            # May be null, or not be there at all.
            lazy = polars.scan_parquet(self._file("lidar_calibration"))
            if name not in lazy.collect_schema().names():
                return np.zeros(0)
            values = lazy.select(name).slice(index, 1).collect()[name][0]
        return np.zeros(0) if values is None else np.asarray(values, np.float64)

    def _file(self, component: str) -> Path:
        return self.folder / self._name(component)

    def _name(self, component: str) -> str:
        return f"{component}/{self.segment}.parquet"

    @contextlib.contextmanager
    def _damage(self, component: str) -> Iterator[None]:
        import polars

        try:
            yield
        except (polars.exceptions.PolarsError, polars.exceptions.PanicException, OSError, ValueError) as error:
            raise ClipError(f"{self._name(component)} is not a readable Parquet file ({str(error)[:200]})") from None


def transforms(where: str, column: polars.Series) -> Float64[np.ndarray, "n 4 4"]:
    """A column of 4x4 matrices, row by row.

    Raises:
        ClipError: they are of another size, or no rigid transforms.
    """
    try:
        poses = column.explode().to_numpy().astype(np.float64).reshape(len(column), 4, 4)
    except (ValueError, TypeError):
        raise ClipError(f"{where}: {column.name!r} must hold lists of 16 numbers") from None
    wrong = ~(geometry.are_rotations(poses[:, :3, :3]) & np.isfinite(poses).all(axis=(1, 2)))
    if wrong.any() or not np.array_equal(poses[:, 3], np.tile((0.0, 0.0, 0.0, 1.0), (len(poses), 1))):
        raise ClipError(f"{where}: {column.name!r} must hold rotations and translations")
    return poses


def floats(where: str, table: polars.DataFrame, columns: Sequence[str]) -> Float64[np.ndarray, "n k"]:
    """Columns of finite numbers.

    Raises:
        ClipError: an entry is no number.
    """
    for name in columns:
        if not table.schema[name].is_numeric() or not np.isfinite(table[name].to_numpy()).all():
            raise ClipError(f"{where}: {name!r} must hold finite numbers")
    return table.select(columns).to_numpy().astype(np.float64).reshape(-1, len(columns))
