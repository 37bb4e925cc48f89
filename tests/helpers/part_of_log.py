"""The first frames of a log, to be written in other formats."""

from pathlib import Path

from nurec_sim import logs
from nurec_sim.types import Rig

DEMO = Path(__file__).parents[2] / "scenarios" / "demo_clip.zip"


def first_frames(clip: logs.Clip, frames: int, cameras: int = 1) -> logs.Clip:
    """The first frames and sweeps of a log's first cameras and its LiDARs; poses and tracks are complete."""
    some = dict(list(clip.rig.cameras.items())[:cameras])
    return logs.Clip(
        id=clip.id,
        rig=Rig(some, clip.rig.lidars, clip.rig.body),
        ego=clip.ego,
        images={name: clip.image_records(name)[:frames] for name in some},
        sweeps={name: clip.sweep_records(name)[:frames] for name in clip.rig.lidars},
        source=clip.source,
        tracks=clip.tracks,
    )
