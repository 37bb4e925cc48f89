"""Reads and validates fields of JSON objects; errors name the file, the location and the allowed values."""

from __future__ import annotations

from typing import Any

import numpy as np

from nurec_sim.errors import ClipError
from nurec_sim.lenses.parameters import LARGEST
from nurec_sim.types import Matrix4

LARGEST_INTEGER = 1 << 62


def required(where: str, row: Any, key: str) -> Any:
    """A required field.

    Raises:
        ClipError: ``row`` is not an object or lacks the field.
    """
    if not isinstance(row, dict):
        raise ClipError(f"{where}: must be a JSON object, got {type(row).__name__}")
    if key not in row:
        raise ClipError(f"{where}: {key!r} is missing; have {sorted(row)}")
    return row[key]


def of_kind(where: str, row: Any, key: str, kind: type, default: Any = None) -> Any:
    """A field of one JSON type (dict, list, str, bool).

    Args:
        where: file and place, for messages.
        row: the object that holds the field.
        key: name of the field.
        kind: the type.
        default: the value if the field is absent or null; None makes the field required.

    Raises:
        ClipError: it is missing without a default, or of another type.
    """
    if default is not None and isinstance(row, dict) and row.get(key) is None:
        return default
    value = required(where, row, key)
    if not isinstance(value, kind):
        raise ClipError(f"{where}: {key!r} must be a {kind.__name__}, got {type(value).__name__}")
    return value


def number(where: str, row: Any, key: str, default: float | None = None) -> float:
    """A finite number.

    Args:
        where: file and place, for messages.
        row: the object that holds the field.
        key: name of the field.
        default: the value if the field is absent or null; None makes the field required.

    Raises:
        ClipError: it is missing without a default, or not a finite number.
    """
    if default is not None and isinstance(row, dict) and row.get(key) is None:
        return default
    value = required(where, row, key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < LARGEST:
        raise ClipError(f"{where}: {key!r} must be a finite number, got {value!r}")
    return float(value)


def integer(where: str, row: Any, key: str) -> int:
    """A whole number.

    Raises:
        ClipError: it is missing or not a whole number.
    """
    value = required(where, row, key)
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > LARGEST_INTEGER:
        raise ClipError(f"{where}: {key!r} must be a whole number, got {value!r}")
    return value


def array(where: str, row: Any, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Nested lists of finite numbers as an array.

    Args:
        where: file and place, for messages.
        row: the object that holds the field.
        key: name of the field.
        shape: the required shape; None stands for any length.

    Raises:
        ClipError: it is missing, ragged, not finite or of another shape.
    """
    value = required(where, row, key)
    try:
        result = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ClipError(f"{where}: {key!r} must be lists of numbers: {error}") from error
    fits = result.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, result.shape, strict=True))
    if not fits:
        wanted = " x ".join("n" if n is None else str(n) for n in shape)
        raise ClipError(f"{where}: {key!r} must have the shape {wanted}, got {result.shape}")
    if not (np.abs(result) < LARGEST).all():
        raise ClipError(f"{where}: {key!r} must be finite, and below {LARGEST:g}")
    return result


def transform(where: str, row: Any, key: str) -> Matrix4:
    """A 4x4 matrix with the last row 0 0 0 1; its rotation is validated later with all others (``consistency``).

    Raises:
        ClipError: it is missing, not finite, not 4x4, or ends in another row.
    """
    matrix = array(where, row, key, (4, 4))
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        raise ClipError(f"{where}: {key!r} must end in the row 0 0 0 1, got {matrix[3].tolist()}")
    return matrix
