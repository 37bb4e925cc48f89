"""Aggregation: one value per rollout and metric, then one row per policy with its interval.

Truncation, both profiles: states after the first collision or off-road state are ignored (driving after a crash is
meaningless), so the two are competing risks. Profile ``alpasim`` also truncates when the ego is 4 m off the recorded
path; ``strict`` does not, and counts how often that occurs (``censored_4m``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nurec_sim.metrics.agreement import percentile_interval, scene_draws
from nurec_sim.metrics.collision import check_profile
from nurec_sim.metrics.series import METRICS

if TYPE_CHECKING:
    import polars as pl

CENSOR_M = 4.0
BRAKES_MPS2 = 2.0
"""A car brakes from here on. Coasting is weaker; the shipped policies brake by 3 m/s2 and more for obstacles."""
MAX_UNKNOWN_FRAC = 0.2
"""Scenes with a larger fraction of unknown states are excluded from ``offroad`` for every policy."""
ROLLOUT_KEYS = (
    "clipgt_id", "world", "reconstruction", "policy", "trial", "seed", "rollout_id", "status", "error",
)  # fmt: skip

DERIVED: dict[str, tuple[str, str]] = {
    "collision_offroad_mean": ("share", "mean of collision_any and offroad"),
    "offroad_or_collision": ("bool", "collision_any or offroad"),
    "scene_score": ("share", "0 after a collision at fault or off-road, else progress / 0.8, at most 1"),
    "time_to_first_event_s": (
        "s",
        "from the first policy-driven state to the first collision or off-road state; none if neither",
    ),
    "time_to_first_brake_s": (
        "s",
        "from the first policy-driven state to the first that brakes by more than 2 m/s2; none if none does",
    ),
    "censored_4m": ("bool", "the ego was 4 m off the recorded path at some time"),
}
"""Rollout-level metrics in addition to ``METRICS``: unit and meaning."""


def rollout_values(table: pl.DataFrame, profile: str = "strict", offroad: str = "offroad") -> pl.DataFrame:
    """One row per rollout and metric: ``ROLLOUT_KEYS``, ``name, unit, value`` (null if not valid), ``valid``.

    A failed rollout keeps its rows, with null values and its error.

    Args:
        table: of ``metric_table``.
        profile: ``strict`` or ``alpasim``.
        offroad: the series that decides ``offroad``: ``offroad`` (the road-class Gaussians) or ``offroad_true`` (the
            log's map).
    """
    import polars as pl

    check_profile(profile)
    rows: list[dict[str, object]] = []
    for part in table.partition_by("rollout_id", maintain_order=True):
        keys = {name: part[name][0] for name in ROLLOUT_KEYS}
        series = {
            name[0]: (rows_["timestamps_us"].to_numpy(), rows_["values"].to_numpy(), rows_["valid"].to_numpy())
            for name, rows_ in part.partition_by("name", as_dict=True).items()
        }
        if offroad in series:
            series["offroad"] = series[offroad]
        values = _rollout_numbers(series, profile) if keys["status"] == "ok" else {}
        units = {name: metric.unit for name, metric in METRICS.items()} | {name: u for name, (u, _) in DERIVED.items()}
        for name, unit in units.items():
            value = values.get(name, np.nan)
            valid = bool(np.isfinite(value))
            rows.append({**keys, "name": name, "unit": unit, "value": float(value) if valid else None, "valid": valid})
    own = {"name": pl.String(), "unit": pl.String(), "value": pl.Float64(), "valid": pl.Boolean()}
    schema = pl.Schema({name: table.schema[name] for name in ROLLOUT_KEYS} | own)
    frame = pl.DataFrame(rows, schema=schema)
    return _without_unseen_scenes(frame) if offroad == "offroad" else frame


def summarize(values: pl.DataFrame, seed: int = 0) -> pl.DataFrame:
    """One row per reconstruction, policy and metric: ``n, n_failed, n_valid, scenes, mean, low, high``.

    ``mean`` is the mean over scenes of the mean over trials, over scenes with a valid trial. ``low``..``high`` is the
    95 % bootstrap interval over scenes; null for a single scene, which does not generalise. All policies and metrics
    share the resamples, so that differences between them are paired.
    """
    import polars as pl

    scenes = sorted(values["clipgt_id"].unique().to_list())
    draws = scene_draws(len(scenes), seed)
    rows = []
    for (world, reconstruction, policy, name), part in values.group_by(
        "world", "reconstruction", "policy", "name", maintain_order=True
    ):
        means = np.full(len(scenes), np.nan)
        for (scene,), trials in part.filter(pl.col("valid")).group_by("clipgt_id"):
            # Sorted, because the rounding of a float sum depends on the order of its terms.
            means[scenes.index(scene)] = trials["value"].sort().mean()
        low, high = _interval(means, draws)
        known = np.isfinite(means)
        rows.append(
            {
                "world": world, "reconstruction": reconstruction, "policy": policy, "name": name,
                "unit": part["unit"][0], "n": len(part), "n_failed": int((part["status"] != "ok").sum()),
                "n_valid": int(part["valid"].sum()), "scenes": int(known.sum()),
                "mean": float(means[known].mean()) if known.any() else None, "low": low, "high": high,
            }
        )  # fmt: skip
    return pl.DataFrame(rows, schema=_summary_schema())


def _summary_schema() -> pl.Schema:
    import polars as pl

    text, whole, real = pl.String(), pl.Int64(), pl.Float64()
    texts = ("world", "reconstruction", "policy", "name", "unit")
    wholes, reals = ("n", "n_failed", "n_valid", "scenes"), ("mean", "low", "high")
    return pl.Schema(dict.fromkeys(texts, text) | dict.fromkeys(wholes, whole) | dict.fromkeys(reals, real))


def _interval(means: np.ndarray, draws: np.ndarray) -> tuple[float | None, float | None]:
    """Percentile interval over resamples of scenes, ignoring those without a valid scene."""
    known = np.isfinite(means)
    if known.sum() < 2:
        return None, None
    # Scenes without a valid value get no weight; the others share the resample's remaining counts.
    weight = draws[:, known]
    total = weight.sum(axis=1)
    drawn = (weight @ means[known])[total > 0] / total[total > 0]
    return percentile_interval(drawn)


def _rollout_numbers(series: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]], profile: str) -> dict[str, float]:
    """Every metric of one rollout as a number, NaN where it has none."""
    # Truncation at the first event (competing risks), in the profile ``alpasim`` also at 4 m from the recorded path.
    event_us = min(_first_us(series.get("collision_any"), 0.5), _first_us(series.get("offroad"), 0.5))
    censor_us = _first_us(series.get("dist_to_gt_trajectory"), CENSOR_M)
    end_us = min(event_us, censor_us) if profile == "alpasim" else event_us
    numbers = {name: _reduce(series[name], METRICS[name].reduce.value, end_us) for name in METRICS if name in series}
    collision, offroad = numbers["collision_any"], numbers["offroad"]
    numbers["collision_offroad_mean"] = (collision + offroad) / 2
    numbers["offroad_or_collision"] = np.nan
    # Three-valued OR: one certain event decides even if the other is unknown.
    if collision == 1 or offroad == 1:
        numbers["offroad_or_collision"] = 1.0
    elif np.isfinite(collision) and np.isfinite(offroad):
        numbers["offroad_or_collision"] = 0.0
    numbers["scene_score"] = _scene_score(numbers)
    numbers["censored_4m"] = float(np.isfinite(censor_us)) if np.isfinite(numbers["dist_to_gt_trajectory"]) else np.nan
    numbers["time_to_first_event_s"] = _time_to_s(series, event_us)
    brake_us = _first_us(series.get("braking_mps2"), BRAKES_MPS2)
    numbers["time_to_first_brake_s"] = _time_to_s(series, brake_us if brake_us <= end_us else np.inf)
    return numbers


def _time_to_s(series: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]], t_us: float) -> float:
    """Seconds from the first policy-driven state; NaN for an infinite time."""
    if not np.isfinite(t_us):
        return float("nan")
    times, relevant, _ = series["eval_relevant"]
    return float(t_us - times[np.argmax(relevant > 0)]) / 1e6


def _scene_score(numbers: dict[str, float]) -> float:
    """AlpaSim's scene score; NaN if one of its parts is unknown."""
    at_fault, offroad = numbers["collision_at_fault"], numbers["offroad"]
    if at_fault == 1 or offroad == 1:
        return 0.0
    if not np.isfinite([at_fault, offroad, numbers["gt_dist_traveled_m"]]).all():
        return float("nan")
    # Progress along a path of less than 5 m is mostly noise: full score, as in AlpaSim.
    if numbers["gt_dist_traveled_m"] < 5:
        return 1.0
    return float(min(np.clip(numbers["progress"], 0, 1) / 0.8, 1))


def _first_us(series: tuple[np.ndarray, np.ndarray, np.ndarray] | None, at_least: float) -> float:
    """First valid time at which the value reaches the threshold; infinite if never."""
    if series is None:
        return float("inf")
    t_us, values, valid = series
    hit = valid & (np.where(valid, values, -np.inf) >= at_least)
    return float(t_us[np.argmax(hit)]) if hit.any() else float("inf")


def _reduce(series: tuple[np.ndarray, np.ndarray, np.ndarray], how: str, end_us: float) -> float:
    t_us, values, valid = series
    kept = values[valid & (t_us <= end_us)]
    if len(kept) == 0:
        return float("nan")
    return float(kept[-1] if how == "last" else getattr(np, how)(kept))


def _without_unseen_scenes(values: pl.DataFrame) -> pl.DataFrame:
    """Invalidates ``offroad`` and derived metrics in scenes with too many unknown states, for all policies."""
    import polars as pl

    unknown = values.filter((pl.col("name") == "offroad_unknown_frac") & pl.col("valid"))
    unseen = (
        unknown.group_by("clipgt_id", "reconstruction").agg(pl.col("value").mean())
        .filter(pl.col("value") > MAX_UNKNOWN_FRAC).select("clipgt_id", "reconstruction", unseen=True)
    )  # fmt: skip
    marked = values.join(unseen, on=["clipgt_id", "reconstruction"], how="left", maintain_order="left")
    builds_on = pl.col("name").is_in(["offroad", "collision_offroad_mean", "offroad_or_collision", "scene_score"])
    hit = pl.col("unseen").fill_null(False) & builds_on
    return marked.with_columns(
        value=pl.when(hit).then(None).otherwise(pl.col("value")), valid=pl.col("valid") & ~hit
    ).drop("unseen")
