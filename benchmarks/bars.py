"""What the renderer must reach, and whether the rows of a run reach it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

Row = dict[str, Any]
MILLISECONDS = (
    ("driving pinhole-640 drive", 25.0),
    ("driving pinhole-960 drive", 34.0),
    ("driving pinhole-1920 drive", 90.0),
    ("driving lidar-128 drive", 38.0),
    ("driving lidar-128-standing drive", 30.0),
    ("2m pinhole-960 drive lod", 75.0),
)
CPU_MILLISECONDS = (
    ("lifted lidar-64-sparse drive", 75.0),
    ("lifted lidar-48-sparse drive", 70.0),
    ("lifted lidar-64 drive", 90.0),
    ("lifted lidar-128 drive", 150.0),
)
RATIOS = (
    ("driving ftheta-1920 drive", "driving pinhole-1920 drive", 1.4),
    ("driving rolling-960 drive", "driving pinhole-960 drive", 1.3),
)
PSNR_DB = 60.0
DETAIL_PSNR_DB = 50.0
RANGE_ERROR_M = 1e-3
BACKWARD_OVER_FORWARD = 2.3
FIRST_FRAME_S = 4.0
SIMPLIFIED = ("ours lod",)
"""Back ends that need not be at ``PSNR_DB`` from the reference."""


def verdicts(rows: Sequence[Row]) -> Iterator[str]:
    """One line per bar whose rows were measured; times hold for the scenes' own numbers and two threads of AVX-512."""
    by_name = {row["name"]: row for row in rows}
    for key, unit, limits in (("ms_median", "ms", MILLISECONDS), ("cpu_ms_median", "ms of CPU", CPU_MILLISECONDS)):
        for name, limit in limits:
            if name in by_name:
                yield verdict(name, by_name[name][key], limit, unit)
    for name, base, limit in RATIOS:
        if name in by_name and base in by_name:
            ratio = by_name[name]["ms_median"] / by_name[base]["ms_median"]
            yield verdict(f"{name} over {base}", ratio, limit, "x")
    yield from _worst(rows, "psnr_vs_spec_db", PSNR_DB, "dB", lambda row: row["backend"] not in SIMPLIFIED)
    yield from _worst(rows, "alpha_psnr_db", PSNR_DB, "dB", lambda row: row["backend"] not in SIMPLIFIED)
    yield from _worst(rows, "depth_psnr_db", PSNR_DB, "dB", lambda row: row["backend"] not in SIMPLIFIED)
    yield from _worst(rows, "psnr_vs_full_db", DETAIL_PSNR_DB, "dB")
    yield from _worst(rows, "lidar_range_error_m_median", RANGE_ERROR_M, "m", largest=True)
    yield from _worst(rows, "backward_over_forward", BACKWARD_OVER_FORWARD, "x", largest=True)
    yield from _worst(rows, "first_frame_s", FIRST_FRAME_S, "s", largest=True)


def verdict(what: str, value: float, limit: float, unit: str, at_most: bool = True) -> str:
    """A value against its limit, in words."""
    reached = value <= limit if at_most else value >= limit
    wanted = f"{'at most' if at_most else 'at least'} {limit:g}"
    return f"{'reached' if reached else 'MISSED '} {what}: {value:.4g} {unit}, {wanted}"


def _worst(rows, key: str, limit: float, unit: str, chosen=lambda row: True, largest: bool = False) -> Iterator[str]:
    """The worst row of a figure."""
    known = [row for row in rows if row.get(key) is not None and chosen(row)]
    if known:
        row = (max if largest else min)(known, key=lambda row: row[key])
        yield verdict(f"worst {key} ({row['name']})", row[key], limit, unit, at_most=largest)
