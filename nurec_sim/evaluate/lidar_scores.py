"""LiDAR scores of a scene: simulated against held-out recorded sweeps, and false obstacles in known free space."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.evaluate.log_regions import RANGES_M, range_name
from nurec_sim.evaluate.scores.free_space import FARTHEST_M, FiredSweep, RecordedBeams, false_obstacles, in_boxes
from nurec_sim.evaluate.scores.lidar import CloudScore, LidarScore, copied_sweep, scanner_along, score_sweep
from nurec_sim.evaluate.scores.surfaces import KINDS, surfaces_of
from nurec_sim.logs.fired import as_fired, fired_fraction
from nurec_sim.reconstruct.free_space import balls, chosen_sweeps, in_free_space, sweep_beams
from nurec_sim.sensors import lidar_model, range_map
from nurec_sim.types import Clip, LidarFrame, LidarModel, Sense, SensorRequest, Sweep

LEFT_M = (0.0, 1.0, 2.0, 3.0)
"""Lateral offsets from the path at which false obstacles are counted, on both sides."""
SCANNER, SCANNER_COLUMNS = "HDL-64", 1200
SCANS = 5
"""Number of instants of a log at which they are counted."""
MOST_BEAM_SWEEPS = 60
"""Maximum number of recorded sweeps that define free space; sampled evenly from longer logs."""
EVERY_RETURN, RETURN_M = 8, 0.03
"""Every n-th recorded return is tested with the log's own beams, as a ball of this standard deviation."""

Report = Callable[[str, float], None]


def score_sweeps(
    clip: Clip, scanners: Mapping[str, LidarModel], held: Sequence[int], sense: Sense, report: Report
) -> dict[str, object]:
    """Scores of held-out sweeps, by the names of their conventions (docs/evaluation.md).

    Along recorded beams: errors of range and intensity, by range and by what the returns lie on. Of whole sweeps:
    Chamfer distances, number of returns, and, where the log's beams are known, which of them return. ``copied`` has the
    figures along beams of the nearest sweep in time that is not held out, in place of the simulated one
    (``scores.lidar.copied_sweep``); None if there is none.

    Args:
        clip: the log.
        scanners: the LiDARs as the scene has them.
        held: indices of the sweeps of every LiDAR to score.
        sense: renders the scene.
        report: called with a stage and the share of it done.
    """
    scores, names, clouds, drops, copies = [], [], [], [], []
    jobs = [(lidar, i) for lidar in clip.rig.lidars for i in held if i < len(clip.sweep_times_us(lidar))]
    for done, (lidar, index) in enumerate(jobs):
        report("held-out sweeps", done / len(jobs))
        sweep = clip.sweep(lidar, index)
        fired, poses = as_fired(clip, lidar, sweep)
        times = sweep.start_us, max(sweep.end_us, sweep.start_us + 1)
        up = np.linalg.inv(sweep.world_from_lidar)[:3, 2]
        surface = surfaces_of(fired, up, in_boxes(sweep.xyz_world_m, clip.tracks, sweep.t_us))
        # Simulated beam by beam: from the same moving sensor, at the elevations of the recorded returns.
        along = scanner_along(clip.rig.lidars[lidar], fired)
        scanner = scanners.get(lidar, clip.rig.lidars[lidar])
        frame, whole = sense([SensorRequest(clip.id, each, *times, poses) for each in (along, scanner)])
        assert isinstance(frame, LidarFrame) and isinstance(whole, LidarFrame)
        scores.append(score_sweep(frame, fired, sweep.intensity, surface))
        seen = geometry.transform_points(poses[1], whole.xyz_m.astype(np.float64))
        clouds.append(CloudScore.of(seen, sweep.xyz_world_m))
        drops.append(_drop_agreement(clip.rig.lidars[lidar], scanner, fired, whole))
        names.append({"lidar": lidar, "sweep": index})
        if (other := _nearest_seen(clip, lidar, index, held)) is not None:
            here = geometry.inverse(sweep.world_from_lidar)
            xyz, instead = (geometry.transform_points(here, each.xyz_world_m) for each in (sweep, other))
            copies.append(copied_sweep(xyz, instead, surface))
    report("held-out sweeps", 1.0)
    return {
        **_along_beams(LidarScore.pooled(scores)),
        "copied": _along_beams(LidarScore.pooled(copies)) if copies else None,
        **_means([cloud.figures() for cloud in clouds]),
        **_means(drops),
        "per_sweep": [
            {
                **name,
                "median_abs_range_error_m": _known(s.median_abs_error_m),
                "return_recall": _known(s.recall),
                "count_ratio": cloud.figures().get("count_ratio"),
            }
            for name, s, cloud in zip(names, scores, clouds, strict=True)
        ],
    }


def _along_beams(total: LidarScore) -> dict[str, object]:
    """Errors along beams: of all, by range, and by what the recorded returns lie on."""
    bins = [(range_name(k), RANGES_M[k], RANGES_M[k + 1]) for k in range(len(RANGES_M) - 1)]

    def by_range(score: LidarScore) -> dict[str, object]:
        return {name: _figures(score.within(low, high)) for name, low, high in bins}

    return {
        **_figures(total),
        "by_range": by_range(total),
        "by_surface": {kind: {**_figures(total.on(kind)), "by_range": by_range(total.on(kind))} for kind in KINDS},
    }


def _nearest_seen(clip: Clip, lidar: str, index: int, held: Sequence[int]) -> Sweep | None:
    """The sweep of the same LiDAR nearest in time that is not held out."""
    middle = clip.sweep_times_us(lidar).sum(axis=1) // 2
    seen = np.setdiff1d(np.arange(len(middle)), held)
    return clip.sweep(lidar, int(seen[np.abs(middle[seen] - middle[index]).argmin()])) if len(seen) else None


def _means(rows: list[dict[str, float]]) -> dict[str, float | None]:
    """Mean of each figure over the sweeps that have it."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    values = {name: [row[name] for row in rows if np.isfinite(row.get(name, np.nan))] for name in names}
    return {name: float(np.mean(found)) if found else None for name, found in values.items()}


def _drop_agreement(
    nominal: LidarModel, scanner: LidarModel, fired: Float64[np.ndarray, "n 3"], simulated: LidarFrame
) -> dict[str, float]:
    """Accuracy, and F1 of drops, over the recorded beams; empty if the log's beams, or the scanner's, are others."""
    beams = range_map(nominal, fired)
    rows, columns = len(scanner.elevation_rad), len(scanner.azimuth_rad)
    if not beams.known or beams.point.shape[0] != rows:
        return {}
    kept = np.zeros((rows, columns), bool)
    kept.reshape(-1)[simulated.beam] = True
    # The number of columns differs by some between turns.
    column = np.rint(np.arange(beams.point.shape[1]) * columns / beams.point.shape[1]).astype(np.int64) % columns
    dropped, recorded = ~kept[:, column], beams.point < 0
    both = np.count_nonzero(dropped & recorded)
    either = np.count_nonzero(dropped) + np.count_nonzero(recorded)
    return {
        "raydrop_acc": float(np.mean(dropped == recorded)),
        "raydrop_f1": 2 * both / either if either else float("nan"),
    }


def _figures(score: LidarScore) -> dict[str, object]:
    error, away = score.abs_error_m, score.abs_perpendicular_m
    away = away[np.isfinite(away)]
    intensity = np.zeros(0) if score.intensity_error is None else np.abs(score.intensity_error)
    intensity = intensity[np.isfinite(intensity)]
    recorded = score.recorded_m[score.returned]
    return {
        "median_abs_range_error_m": _known(score.median_abs_error_m),
        "mean_abs_range_error_m": _mean(error),
        "p95_abs_range_error_m": _known(np.percentile(error, 95) if len(error) else np.nan),
        "depth_median_l2": _known(np.median(error**2) if len(error) else np.nan),
        "depth_mean_rel_l2": _mean((error / recorded) ** 2),
        "median_perpendicular_m": _known(np.median(away) if len(away) else np.nan),
        "mean_perpendicular_m": _mean(away),
        "intensity_mae": _mean(intensity),
        "intensity_rmse": _known(np.sqrt(np.mean(intensity**2)) if len(intensity) else np.nan),
        "return_recall": _known(score.recall),
        "within_0.1_m": _within(score, 0.1),
        "within_0.5_m": _within(score, 0.5),
        "beams": score.beams,
    }


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _within(score: LidarScore, limit_m: float) -> float | None:
    """Share of beams with a recorded return whose simulated return exists with a range error below the limit."""
    return float((score.abs_error_m < limit_m).sum() / score.beams) if score.beams else None


def _known(value: float) -> float | None:
    """JSON has no NaN: undefined values become null."""
    return float(value) if np.isfinite(value) else None


def score_free_space(clip: Clip, sense: Sense, report: Report) -> dict[str, object] | None:
    """Share of simulated returns within 40 m in space known to be free, on the path and beside it; None without LiDAR.

    A ``SCANNER`` at the mounting of the log's first LiDAR is simulated at a few instants, with the car stationary.

    Returns:
        ``false_obstacles`` by offset, and ``recorded_in_free_space``: the share of the log's own returns at these
        instants that its beams passed through, by the rule of ``reconstruct.free_space``. Leaves and movers give 1 to
        2 %; several percent say that beams did not start where the log has its LiDAR, as in sweeps merged from several,
        and that the first figure means little.
    """
    lidar = next((name for name in clip.rig.lidars if len(clip.sweep_times_us(name))), None)
    if lidar is None:
        return None
    beams = _recorded_beams(clip)
    mounting = clip.rig.lidars[lidar].rig_from_lidar
    scanner = lidar_model(SCANNER, mounting, columns=SCANNER_COLUMNS)
    times = clip.sweep_times_us(lidar).sum(axis=1) // 2
    instants = times[np.unique(np.linspace(0, len(times) - 1, min(SCANS, len(times))).round().astype(int))]
    shares: dict[str, float | None] = {}
    offsets = sorted({side * left for left in LEFT_M for side in (1, -1)}, key=lambda left: (abs(left), left))
    counts = {abs(left): [0, 0] for left in offsets}
    for done, left in enumerate(offsets):
        report("false obstacles", done / len(offsets))
        for t_us in instants:
            pose = clip.ego.at(int(t_us)) @ geometry.pose_from_xyyaw(0.0, left, 0.0) @ mounting
            request = SensorRequest(clip.id, scanner, int(t_us), int(t_us) + 1, np.stack([pose, pose]))
            (frame,) = sense([request])
            assert isinstance(frame, LidarFrame)
            near = frame.xyz_m[frame.range_m < FARTHEST_M].astype(np.float64)
            xyz = geometry.transform_points(pose, near)
            false, total = false_obstacles(xyz, beams, clip.tracks, int(t_us))
            counts[abs(left)][0] += false
            counts[abs(left)][1] += total
    report("false obstacles", 1.0)
    for left, (false, total) in counts.items():
        shares[f"{left:g} m"] = false / total if total else None
    return {"false_obstacles": shares, "recorded_in_free_space": _contradicted(clip, lidar, instants)}


def _contradicted(clip: Clip, lidar: str, instants: Int64[np.ndarray, " n"]) -> float | None:
    """Share of recorded returns within reach, outside boxes of movers, that the log's own beams passed through."""
    beams = [sweep_beams(clip, name, clip.sweep(name, index)) for name, index in chosen_sweeps(clip, ())]
    middle = clip.sweep_times_us(lidar).sum(axis=1) // 2
    passed = total = 0
    for t_us in instants:
        sweep = clip.sweep(lidar, int(np.abs(middle - t_us).argmin()))
        near = np.linalg.norm(sweep.xyz_m, axis=1) < FARTHEST_M
        xyz = sweep.xyz_world_m[near][::EVERY_RETURN]
        xyz = xyz[~in_boxes(xyz, clip.tracks, sweep.t_us)]
        passed += int(in_free_space(balls(xyz, np.full(len(xyz), RETURN_M, np.float32)), beams).sum())
        total += len(xyz)
    return passed / total if total else None


def _recorded_beams(clip: Clip) -> RecordedBeams:
    fired, ends = [], []
    for lidar, index in chosen_sweeps(clip, (), MOST_BEAM_SWEEPS):
        sweep = clip.sweep(lidar, index)
        xyz, poses = as_fired(clip, lidar, sweep)
        fired.append(FiredSweep(xyz, fired_fraction(sweep), poses))
        ends.append(sweep.xyz_world_m)
    return RecordedBeams(fired, np.concatenate(ends))
