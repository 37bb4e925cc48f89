"""Closed-loop metrics: per-rollout series, the off-road grid, tables and summaries.

Public names load on first use, so that importing the package costs nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "aggregate": ["rollout_values", "summarize"],
        "agreement": ["compare_worlds", "holm", "noise_ceiling", "paired_means", "policy_differences"],
        "collision": ["Contact", "find_contacts"],
        "offroad": ["judge_footprints"],
        "offroad_agreement": ["RoadAgreement", "road_agreement"],
        "offroad_grid": ["GridSettings", "OffroadGrid", "build_offroad_grid", "scene_offroad_grid"],
        "score": ["score_rollout"],
        "series": ["METRICS"],
        "table": ["metric_table", "read_table", "write_table"],
    },
)
