"""What a sensor service allows."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from nurec_sim.compute.cores import usable_cores
from nurec_sim.render.requests import MAX_RAYS
from nurec_sim.serving import wire


@dataclass(frozen=True)
class ServiceOptions:
    """Limits and choices of a sensor server."""

    render_workers: int = field(default_factory=usable_cores)
    """Frames rendered at the same time, in threads of their own beside the renderer's; as many as there are cores."""
    max_pixels: int = MAX_RAYS
    """Pixels, or beams, of one frame; the renderer takes no more than the default."""
    max_batch_items: int = 64
    max_call_rays: int = 1 << 27
    """Pixels and beams of all frames of a call: 64 images of 1920 x 1080."""
    max_client_rays: int = 1 << 28
    """Pixels and beams that the calls of one connection ask for at a time; one call always may."""
    max_actors: int = 4096
    """Actors that a request for a frame may place; logs have a few hundred."""
    max_request_bytes: int = 16 << 20
    """Of a request, or of a part of an upload; what is larger is not even received."""
    max_message_bytes: int = wire.MAX_MESSAGE_BYTES
    """Of a reply."""
    only_listed_actors: bool = False
    """Whether a request that lists actors hides the controllable ones that it does not list."""
    ego_mask_dir: Path | None = None
    allow_shut_down: bool = False
    warm_up: bool = False
    """Whether the first scene is loaded, and kernels are compiled, before the first call."""
    max_edited_scenes: int = 8
    """Scenes of which ``edit_assets`` keeps an edited copy in memory."""
    allow_remote_scenes: bool = False
    """Whether clients may name ``http(s)://`` addresses of scenes, and not only ``file://`` ones."""
    scene_dirs: tuple[Path, ...] | None = None
    """Folders, and files, that ``file://`` addresses may lead to; None for the folders of the scenes that the store has
    when the service starts."""
    allow_any_file: bool = False
    """Whether ``file://`` addresses may lead to any file that the server can read."""
    download_cache_dir: Path | None = None
    """Where downloaded scenes are kept; None for a folder in that of the store."""
    download_cache_size: int = 5
    """Scenes kept there; the least recently used one is removed first."""
    max_download_bytes: int = 4 << 30
    """Of one scene."""
    download_timeout_s: float = 300.0
    """For one scene."""

    def __post_init__(self) -> None:
        counts = ("render_workers", "max_pixels", "max_batch_items", "max_call_rays", "max_client_rays", "max_actors",
                  "max_request_bytes", "max_message_bytes", "download_cache_size", "max_download_bytes")  # fmt: skip
        for name in counts:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("max_edited_scenes", "download_timeout_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
