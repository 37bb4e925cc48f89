"""How well the points of each LiDAR fit the beams of its model; see ``sensors.range_map``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nurec_sim.logs.checks.measure import Measure
from nurec_sim.logs.checks.sampling import SampledSweep
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.fired import as_fired
from nurec_sim.sensors import range_map


def check_beams(clip: Clip, sweeps: Sequence[SampledSweep]) -> list[Measure]:
    """One row per LiDAR: beams found, share of the points on a beam of their own, residual, and share that returns.

    Never a fault: merged and compensated clouds without times are useful, only their beams are not known.
    """
    rows = []
    for name, lidar in clip.rig.lidars.items():
        maps = [range_map(lidar, as_fired(clip, name, each.sweep)[0]) for each in sweeps if each.lidar_id == name]
        if not maps:
            continue
        mapped = float(np.median([each.mapped for each in maps]))
        if sum(each.known for each in maps) * 2 < len(maps):
            found = f"not known: {100 * mapped:.0f} % of the points fit; merged, thinned, or without times of points"
        else:
            rows_by_columns = " x ".join(
                str(int(np.median(n))) for n in zip(*(m.point.shape for m in maps), strict=True)
            )
            residual = np.degrees(np.median([np.median(each.residual_rad) for each in maps]))
            returns = np.median([(each.point >= 0).mean() for each in maps])
            found = (
                f"{rows_by_columns}, {100 * mapped:.1f} % of the points have one of their own, {residual:.3f} degrees "
                f"from it; {100 * returns:.0f} % return"
            )
        rows.append(Measure(f"beams of LiDAR {name!r}", found))
    return rows
