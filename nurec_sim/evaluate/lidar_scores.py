"""LiDAR scores of a scene: simulated against held-out recorded sweeps, and false obstacles in known free space."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.evaluate.log_regions import RANGES_M, range_name
from nurec_sim.evaluate.scores.free_space import FARTHEST_M, FiredSweep, RecordedBeams, false_obstacles
from nurec_sim.evaluate.scores.lidar import LidarScore, scanner_along, score_sweep
from nurec_sim.sensors.lidar_tables import lidar_model
from nurec_sim.types import Clip, LidarFrame, Sense, SensorRequest, Sweep

LEFT_M = (0.0, 1.0, 2.0, 3.0)
"""Lateral offsets from the path at which false obstacles are counted, on both sides."""
SCANNER, SCANNER_COLUMNS = "HDL-64", 1200
SCANS = 5
"""Number of instants of a log at which they are counted."""
MOST_BEAM_SWEEPS = 60
"""Maximum number of recorded sweeps that define free space; sampled evenly from longer logs."""

Report = Callable[[str, float], None]


def score_sweeps(clip: Clip, held: Sequence[int], sense: Sense, report: Report) -> dict[str, object]:
    """Scores of held-out sweeps: range errors, also by range bin, and Chamfer distances.

    Args:
        clip: the log.
        held: indices of the sweeps of every LiDAR to score.
        sense: renders the scene.
        report: called with a stage and the share of it done.
    """
    scores, names = [], []
    jobs = [(lidar, i) for lidar in clip.rig.lidars for i in held if i < len(clip.sweep_times_us(lidar))]
    for done, (lidar, index) in enumerate(jobs):
        report("held-out sweeps", done / len(jobs))
        sweep = clip.sweep(lidar, index)
        fired, poses = as_fired(clip, lidar, sweep)
        scanner = scanner_along(clip.rig.lidars[lidar], fired)
        # Simulated beam by beam: from the same moving sensor, at the elevations of the recorded returns.
        request = SensorRequest(clip.id, scanner, sweep.start_us, max(sweep.end_us, sweep.start_us + 1), poses)
        frame = sense([request])[0]
        assert isinstance(frame, LidarFrame)
        scores.append(score_sweep(frame, fired))
        names.append({"lidar": lidar, "sweep": index})
    report("held-out sweeps", 1.0)
    total = LidarScore.pooled(scores)
    clouds = np.array([score.chamfer() for score in scores]).reshape(-1, 2)
    precision, coverage = np.nanmean(clouds, axis=0) if np.isfinite(clouds).any() else (np.nan, np.nan)
    bins = zip(RANGES_M[:-1], RANGES_M[1:], strict=True)
    return {
        **_figures(total),
        "by_range": {range_name(k): _figures(total.within(low, high)) for k, (low, high) in enumerate(bins)},
        "cd_l1_sum": _known(precision + coverage),
        "precision_m": _known(precision),
        "coverage_m": _known(coverage),
        "per_sweep": [
            {**name, "median_abs_range_error_m": _known(s.median_abs_error_m), "return_recall": _known(s.recall)}
            for name, s in zip(names, scores, strict=True)
        ],
    }


def _figures(score: LidarScore) -> dict[str, object]:
    error = score.abs_error_m
    return {
        "median_abs_range_error_m": _known(score.median_abs_error_m),
        "mean_abs_range_error_m": _known(error.mean() if len(error) else np.nan),
        "p95_abs_range_error_m": _known(np.percentile(error, 95) if len(error) else np.nan),
        "return_recall": _known(score.recall),
        "within_0.1_m": _within(score, 0.1),
        "within_0.5_m": _within(score, 0.5),
        "beams": score.beams,
    }


def _within(score: LidarScore, limit_m: float) -> float | None:
    """Share of beams with a recorded return whose simulated return exists with a range error below the limit."""
    return float((score.abs_error_m < limit_m).sum() / score.beams) if score.beams else None


def _known(value: float) -> float | None:
    """JSON has no NaN: undefined values become null."""
    return float(value) if np.isfinite(value) else None


def score_free_space(clip: Clip, sense: Sense, report: Report) -> dict[str, object] | None:
    """Share of simulated returns within 40 m in space known to be free, on the path and beside it; None without LiDAR.

    A ``SCANNER`` at the mounting of the log's first LiDAR is simulated at a few instants, with the car stationary.
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
    return {"false_obstacles": shares}


def _recorded_beams(clip: Clip) -> RecordedBeams:
    fired, ends = [], []
    for lidar, index in _chosen_sweeps(clip):
        sweep = clip.sweep(lidar, index)
        xyz, poses = as_fired(clip, lidar, sweep)
        fired.append(FiredSweep(xyz, _fraction(sweep), poses))
        ends.append(sweep.xyz_world_m)
    return RecordedBeams(fired, np.concatenate(ends))


def _chosen_sweeps(clip: Clip) -> list[tuple[str, int]]:
    every = [(name, index) for name in clip.rig.lidars for index in range(len(clip.sweep_times_us(name)))]
    chosen = np.unique(np.linspace(0, len(every) - 1, min(MOST_BEAM_SWEEPS, len(every))).round().astype(int))
    return [every[k] for k in chosen]


def _fraction(sweep: Sweep) -> Float64[np.ndarray, " n"]:
    return np.clip((sweep.point_t_us - sweep.start_us) / max(sweep.end_us - sweep.start_us, 1), 0, 1)


def as_fired(clip: Clip, lidar: str, sweep: Sweep) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "2 4 4"]]:
    """Undoes motion compensation: returns in the sensor frame at firing time, and the poses at sweep start and end."""
    rig_from_lidar = clip.rig.lidars[lidar].rig_from_lidar
    # The sweep's own pose in the log is the reference; the ego trajectory only contributes the motion around it.
    fix = sweep.world_from_lidar @ geometry.inverse(clip.ego.at(sweep.t_us) @ rig_from_lidar)
    times = np.array([sweep.start_us, sweep.end_us])
    poses = np.einsum("ij,njk->nik", fix, clip.ego.at(times) @ rig_from_lidar)
    inverse = geometry.inverse(geometry.interpolate_pose_pair(poses, _fraction(sweep)))
    return np.einsum("nij,nj->ni", inverse[:, :3, :3], sweep.xyz_world_m) + inverse[:, :3, 3], poses
