"""Evaluation of reconstructions against recorded sensors and against procedural worlds.

``evaluate`` scores one log with held-out cameras and sweeps. ``run_protocol`` compares methods
(docs/evaluation.md) on windows of procedural worlds or of real logs. Public names load on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "comparison": ["compare_scenes"],
        "comparison_page": ["render_comparison"],
        "fidelity": ["measure_fidelity"],
        "log": ["evaluate", "score_scene", "sensing"],
        "log_tables": ["figure_rows", "side_by_side"],
        "methods": ["CHOICES", "Contender", "contenders"],
        "protocols": ["PROTOCOLS", "Protocol"],
        "run": ["run_protocol"],
        "scoring": ["score_window"],
        "summary": ["summarize"],
        "windows": ["EvaluationView", "Window"],
    },
)
