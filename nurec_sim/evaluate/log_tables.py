"""The figures of ``log.score_scene`` as rows for people: one scene, or several side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nurec_sim.evaluate.scores.sharpness import OCTAVES

SEEN = {"seen": "frames it was made from", "unseen": "frames it has not seen"}


@dataclass(frozen=True)
class Row:
    """One figure of a scene; ``better`` is 1 where more is better, -1 where less is, 0 where neither."""

    group: str
    name: str
    value: float | None
    digits: int = 3
    better: int = 0

    @property
    def text(self) -> str:
        """The value to print."""
        return "not known" if self.value is None else f"{self.value:.{self.digits}f}"


def figure_rows(figures: Mapping[str, Any]) -> list[Row]:
    """All headline figures, in the order in which they are read; the same names for every scene of a log."""
    rows = []
    for key, title in SEEN.items():
        if frames := figures["image"].get(key):
            rows += _image_rows(f"Images: {title}", frames)
    if lidar := figures["lidar"]:
        rows += _lidar_rows(lidar)
    if free := figures["free_space"]:
        for left, share in free["false_obstacles"].items():
            percent = None if share is None else 100 * share
            rows.append(Row("False obstacles", f"{left} beside the path (% of returns)", percent, 2, -1))
        own = free["recorded_in_free_space"]
        rows.append(
            Row("False obstacles", "recorded returns, for comparison (%)", None if own is None else 100 * own, 2)
        )
    if road := figures["road"]:
        rows += [
            Row("Road", "off-road agrees with the map", road.get("agreement"), 3, 1),
            Row("Road", "edge beyond the map's, median (m)", road.get("boundary_bias_m"), 3),
        ]
    if actors := figures.get("actors"):
        rows += _actor_rows(actors)
    if detection := figures.get("detection"):
        rows += _detection_rows(detection)
    rows += [
        Row("Scene", "static Gaussians", figures["counts"]["static"], 0),
        Row("Scene", "moving Gaussians", figures["counts"]["dynamic"], 0),
    ]
    if (seconds := figures["seconds"].get("reconstruct")) is not None:
        rows.append(Row("Scene", "reconstruction (s)", seconds, 1, -1))
    return rows


def _lidar_rows(lidar: Mapping[str, Any]) -> list[Row]:
    """Sweeps as wholes first, then beams by range, then by what they hit; medians never without what they hide."""
    group = "LiDAR: sweeps held out"
    rows = [
        Row(group, "returns, simulated / recorded", lidar.get("count_ratio"), 3),
        Row(group, "Chamfer: precision + coverage (m)", lidar.get("cd_l1_sum"), 3, -1),
        Row(group, "precision (m)", lidar.get("precision_m"), 3, -1),
        Row(group, "coverage (m)", lidar.get("coverage_m"), 3, -1),
        Row(group, "F-score at 0.1 m", lidar.get("fscore@0.10"), 3, 1),
        Row(group, "intensity, mean error", lidar["intensity_mae"], 3, -1),
        Row(group, "beams that return or not as recorded", lidar.get("raydrop_acc"), 3, 1),
    ]
    for name, part in [("all ranges", lidar), *lidar["by_range"].items()]:
        rows += [
            Row(group, f"mean error, {name} (m)", part["mean_abs_range_error_m"], 2, -1),
            Row(group, f"95th percentile, {name} (m)", part["p95_abs_range_error_m"], 2, -1),
            Row(group, f"median error, {name} (m)", part["median_abs_range_error_m"], 3, -1),
            Row(group, f"within 0.1 m, {name}", part["within_0.1_m"], 3, 1),
            Row(group, f"recorded beams that return, {name}", part["return_recall"], 3, 1),
        ]
    for kind, parts in lidar["by_surface"].items():
        what, key = ("perpendicular", "perpendicular_m") if kind == "ground" else ("range", "abs_range_error_m")
        for name, part in [("all ranges", parts), *parts["by_range"].items()]:
            if part["beams"]:
                title = f"{kind}, {name}"
                rows += [
                    Row(f"LiDAR: {kind}", f"median {what} error, {title} (m)", part[f"median_{key}"], 3, -1),
                    Row(f"LiDAR: {kind}", f"mean {what} error, {title} (m)", part[f"mean_{key}"], 2, -1),
                ]
        rows.append(Row(f"LiDAR: {kind}", f"beams, {kind}", parts["beams"], 0))
    if copied := lidar.get("copied"):
        group = "LiDAR: copying the nearest recorded sweep, for comparison"
        for name, part in [("all ranges", copied), *copied["by_range"].items()]:
            rows += [
                Row(group, f"copied, mean error, {name} (m)", part["mean_abs_range_error_m"], 2),
                Row(group, f"copied, median error, {name} (m)", part["median_abs_range_error_m"], 3),
                Row(group, f"copied, within 0.1 m, {name}", part["within_0.1_m"], 3),
            ]
    return rows


def _actor_rows(actors: Mapping[str, Any]) -> list[Row]:
    group, instants = "Found actors against the log's boxes, up to 40 m", actors["instants"]
    return [
        Row(group, "recall of moving vehicles", actors["recall"], 3, 1),
        Row(group, "recall of moving people", actors["recall_people"], 3, 1),
        Row(group, "precision", actors["precision"], 3, 1),
        Row(group, "centres of vehicles, median error (m)", actors["centre_m"], 2, -1),
        Row(group, "velocities of vehicles, median error (m/s)", actors["speed_mps"], 2, -1),
        *(Row(group, f"instants of {name}", count, 0) for name, count in instants.items()),
    ]


def _detection_rows(detection: Mapping[str, Any]) -> list[Row]:
    """Recorded images first, the same figures of rendered ones below."""
    group = "Camera detector, recorded and rendered images"
    rows = [Row(group, "images", detection["images"], 0)] if "images" in detection else []
    for name, figures in detection.get("figures", {}).items():
        rows += [
            Row(group, f"{name}: visible objects", figures["there"], 0),
            Row(group, f"{name}: detections, recorded", figures["true_found"], 0),
            Row(group, f"{name}: detections, rendered", figures["found"], 0),
            Row(group, f"{name}: precision, recorded", figures["true_precision"], 3),
            Row(group, f"{name}: precision, rendered", figures["precision"], 3),
            Row(group, f"{name}: recall, recorded", figures["true_recall"], 3),
            Row(group, f"{name}: recall, rendered", figures["recall"], 3),
            Row(group, f"{name}: kept in rendered", figures["kept"], 3, 1),
            Row(group, f"{name}: backed by recorded", figures["backed"], 3, 1),
        ]
    return rows


def _image_rows(group: str, frames: Mapping[str, Any]) -> list[Row]:
    rows = [
        Row(group, "frames", frames["frames"], 0),
        Row(group, "PSNR (dB)", frames["psnr_db"], 2, 1),
        Row(group, "SSIM", frames["ssim"], 3, 1),
        Row(group, "FLIP", frames["flip"], 3, -1),
    ]
    cameras = frames["camera_psnr_db"] if len(frames["camera_psnr_db"]) > 1 else {}
    parts = [*frames["region_psnr_db"].items(), *cameras.items()]
    rows += [Row(group, f"PSNR, {name} (dB)", value, 2, 1) for name, value in parts]
    rows += [Row(group, f"sharpness from {name} cycle/px", frames["sharpness"][name], 2) for name in OCTAVES]
    holes = {name: None if share is None else 100 * share for name, share in frames["holes"].items()}
    return rows + [Row(group, f"holes, {name} (%)", share, 2, -1) for name, share in holes.items()]


def side_by_side(scenes: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, list[Row | None]]]:
    """Group, name and the rows of all scenes, None where a scene lacks the figure; in the first scene's order."""
    tables = {name: {(row.group, row.name): row for row in figure_rows(figures)} for name, figures in scenes.items()}
    keys: Sequence[tuple[str, str]] = list(dict.fromkeys(key for table in tables.values() for key in table))
    return [(group, name, [table.get((group, name)) for table in tables.values()]) for group, name in keys]
