"""The log of a command with its recorded poses, or with refined ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from nurec_sim.cli.console import print_table, progress

if TYPE_CHECKING:
    from nurec_sim.logs import Clip

PosesName = Literal["recorded", "refined"]


def with_poses(log: Clip, poses: PosesName) -> Clip:
    """A log with its recorded poses, or refined by its LiDAR; a table then says how well they fit.

    Raises:
        ClipError: the log has no LiDAR by which poses could be refined.
    """
    if poses == "recorded":
        return log
    from nurec_sim.logs.odometry import refine_poses

    with progress("refining poses") as advance:
        log, report = refine_poses(log, advance)
    print_table("refined poses", report.rows)
    return log
