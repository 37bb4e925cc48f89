"""Run folders: runs policies, stores rollouts, computes metrics, writes reports; interrupted runs can be resumed.

Public names load on first use, so that importing the package costs nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "added_actors": ["AddedActors", "add_to_served", "added_actors", "with_added_actors"],
        "drive": ["execute"],
        "policies": ["load_policies"],
        "results": ["headline", "write_report"],
        "rollout_file": ["load_rollout", "save_rollout"],
        "scene_file": ["reconstruction_of"],
        "sources": ["load_all", "offer_all"],
        "truth": ["true_world"],
        "video": ["record_video"],
    },
)
