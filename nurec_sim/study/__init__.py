"""Studies: does a reconstruction rank policies as the true world does?

Procedural towns are recorded, reconstructed, and driven in by the same policies with the same random numbers, in the
town itself and in every reconstruction (docs/study.md). Public names load on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "config": ["StudyConfig", "load_study", "make_study", "shipped_studies"],
        "controls": ["CONTROLS"],
        "executor": ["Executor", "LocalProcesses"],
        "ray_cluster": ["RayCluster"],
        "results": ["StudyResults", "agreement_rows", "read_agreement"],
        "run": ["report_again", "run_study"],
    },
)
