"""Lossless JSON encoding of rigs, tracks, trajectories and road maps.

A dataclass becomes an object of its fields plus ``"type"``; arrays become nested lists. Float64 values are exact
(shortest round-trip representation). NaN and infinity are refused.
"""

from __future__ import annotations

import dataclasses
import enum
import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import TooMuchError, check_json, json_value
from nurec_sim.lenses import decode_parameters, lens_class
from nurec_sim.types import (
    Box,
    CameraModel,
    Lens,
    LidarModel,
    Rig,
    RoadMap,
    Shutter,
    Spin,
    Track,
    Trajectory,
    Windshield,
    WindshieldReference,
)

Decoder = Callable[[Any], Any]


def to_json(value: Any) -> Any:
    """Plain JSON of a value of this module's types, numbers, strings, arrays, sequences and mappings."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: to_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
        for name, default in _ADDED.get(type(value), {}).items():
            if fields[name] == default:
                del fields[name]
        return {"type": type(value).__name__, **fields}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    return value


def dump(value: Any, what: str, indent: int | None = None) -> bytes:
    """JSON text in UTF-8, keys in the given order.

    Raises:
        ArchiveError: NaN, infinity, a key that is not text, an unsupported type, or too much data.
    """
    try:
        separators = (",", ": ") if indent else (",", ":")
        text = json.dumps(to_json(value), allow_nan=False, ensure_ascii=False, separators=separators, indent=indent)
        data = (text + "\n").encode("utf-8")
        check_json(data)
        return data
    except TooMuchError as error:
        raise ArchiveError(f"{what} {error}, so it is not written") from None
    except (TypeError, ValueError) as error:
        raise ArchiveError(f"{what} cannot be written as JSON: {error}") from error


def load(text: bytes, what: str) -> Any:
    """The value of a JSON text; duplicate keys, NaN and infinity are refused.

    Raises:
        ArchiveError: not JSON, or too much data.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not allowed")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) != len(pairs):
            raise ValueError("a key appears twice")
        return result

    try:
        return json_value(text, parse_constant=refuse, object_pairs_hook=unique)
    except TooMuchError as error:
        raise ArchiveError(f"{what} {error}") from None
    except (ValueError, RecursionError) as error:
        raise ArchiveError(f"{what} is not valid JSON: {error}") from error


# -------------------------------------------------------------------------------------------------- field decoders


def number(value: Any) -> float:
    """A finite float."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise ValueError(f"expected a finite number, got {value!r:.60}")
    return float(value)


def integer(value: Any) -> int:
    """A 64-bit integer."""
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        raise ValueError(f"expected a 64-bit integer, got {value!r:.60}")
    return value


def text(value: Any) -> str:
    """A string."""
    if not isinstance(value, str):
        raise ValueError(f"expected text, got {value!r:.60}")
    return value


def flag(value: Any) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise ValueError(f"expected true or false, got {value!r:.60}")
    return value


def numbers(count: int | None = None) -> Decoder:
    """A tuple of floats, of a given length if ``count`` is."""

    def decode(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or (count is not None and len(value) != count):
            raise ValueError(f"expected {'a list of' if count is None else count} numbers, got {value!r:.60}")
        return tuple(number(item) for item in value)

    return decode


def array(dtype: type, *shape: int) -> Decoder:
    """An array of ``dtype``; -1 in ``shape`` stands for any length, in the first place only."""

    def decode(value: Any) -> np.ndarray:
        # NumPy infers the type first, so that texts or booleans among the numbers are noticed.
        raw = np.array(value)
        if raw.size == 0 and shape[0] < 0:
            return np.zeros((0, *shape[1:]), dtype)
        if raw.ndim != len(shape) or raw.shape[1:] != shape[1:] or shape[0] not in (-1, len(raw)):
            wanted = "x".join("n" if length < 0 else str(length) for length in shape)
            raise ValueError(f"expected an array {wanted}, got shape {raw.shape}")
        if raw.dtype.kind not in ("i" if np.issubdtype(dtype, np.integer) else "if"):
            raise ValueError(f"expected {np.dtype(dtype).name} numbers, got {raw.dtype}")
        return raw.astype(dtype)

    return decode


def choice(kind: type[enum.Enum]) -> Decoder:
    """A member of an enumeration, by value."""
    return kind


def optional(decoder: Decoder) -> Decoder:
    """None or a value for ``decoder``."""
    return lambda value: None if value is None else decoder(value)


def sequence(decoder: Decoder) -> Decoder:
    """A tuple of items."""

    def decode(value: Any) -> tuple:
        if not isinstance(value, list):
            raise ValueError(f"expected a list, got {value!r:.60}")
        return tuple(decoder(item) for item in value)

    return decode


def mapping(decoder: Decoder) -> Decoder:
    """A dictionary with text keys, in order."""

    def decode(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise ValueError(f"expected an object, got {value!r:.60}")
        return {key: _within(key, decoder, item) for key, item in value.items()}

    return decode


def record(*kinds: type) -> Decoder:
    """One of the dataclasses ``kinds``, selected by ``"type"``; fields must match exactly."""

    def decode(value: Any) -> Any:
        allowed = {kind.__name__: kind for kind in kinds}
        if not isinstance(value, dict) or value.get("type") not in allowed:
            given = value.get("type") if isinstance(value, dict) else value
            raise ValueError(f"expected an object of type {sorted(allowed)}, got {given!r:.60}")
        kind = allowed[value["type"]]
        fields, value = _FIELDS[kind], {**_ADDED.get(kind, {}), **value}
        if set(value) - {"type"} != set(fields):
            raise ValueError(f"{value['type']} needs the fields {sorted(fields)}, got {sorted(set(value) - {'type'})}")
        return kind(**{name: _within(name, decoder, value[name]) for name, decoder in fields.items()})

    return decode


def lens(value: Any) -> Lens:
    """A lens of any registered kind, named by its class in ``"type"``; all its parameters must be there."""
    if not isinstance(value, dict) or not isinstance(value.get("type"), str):
        raise ValueError(f"expected an object with the 'type' of a lens, got {value!r:.60}")
    kind = lens_class(value["type"])
    parameters = {name: item for name, item in value.items() if name != "type"}
    return _within(kind.__name__, lambda row: decode_parameters(kind, row, complete=True), parameters)


def _within(name: str, decoder: Decoder, value: Any) -> Any:
    """Decodes a part and prefixes error texts with its name."""
    try:
        return decoder(value)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


_FIELDS: dict[type, dict[str, Decoder]] = {
    Trajectory: {"t_us": array(np.int64, -1), "world_from_body": array(np.float64, -1, 4, 4)},
    Windshield: {
        "reference": choice(WindshieldReference), "horizontal": numbers(), "vertical": numbers(),
        "horizontal_inverse": numbers(), "vertical_inverse": numbers(),
    },
    CameraModel: {
        "id": text, "width_px": integer, "height_px": integer, "lens": lens,
        "rig_from_camera": array(np.float64, 4, 4), "shutter": choice(Shutter),
        "windshield": optional(record(Windshield)),
    },
    LidarModel: {
        "id": text, "elevation_rad": array(np.float64, -1), "azimuth_rad": array(np.float64, -1),
        "row_azimuth_offset_rad": array(np.float64, -1), "rig_from_lidar": array(np.float64, 4, 4),
        "spin": choice(Spin), "frequency_hz": number, "range_m": numbers(2), "blocked": array(np.int64, -1),
    },
    Box: {"center_m": numbers(3), "size_m": numbers(3)},
    Rig: {"cameras": mapping(record(CameraModel)), "lidars": mapping(record(LidarModel)), "body": record(Box)},
    Track: {
        "id": text, "label": text, "size_m": numbers(3), "path": record(Trajectory), "controllable": flag,
        "labelled": flag, "actor": flag,
    },
    RoadMap: {
        "drivable": sequence(sequence(array(np.float64, -1, 2))), "lanes": sequence(array(np.float64, -1, 3)),
    },
}  # fmt: skip


_ADDED: dict[type, dict[str, Any]] = {
    Track: {"labelled": True, "actor": True},
    LidarModel: {"blocked": []},
}
"""Fields missing in older archives, with defaults; written only if different."""


def from_json(decoder: Decoder, value: Any, what: str) -> Any:
    """Decodes a value.

    Raises:
        ArchiveError: a field is missing, unknown or of the wrong type; the text gives its location.
    """
    try:
        return decoder(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise ArchiveError(f"{what}: {error}") from error
