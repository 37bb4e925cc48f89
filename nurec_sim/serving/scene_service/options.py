"""What the scene service allows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class SceneOptions:
    """What the scene service allows; limits of frames and messages are those of ``ServiceOptions``."""

    upload_dir: Path | None = None
    """Where uploaded scenes and clips are kept, and offered again when a server starts; None: nobody may upload."""
    max_upload_bytes: int = 4 << 30
    """Of one file; a scene archive cannot be larger."""
    max_uploaded_bytes: int = 64 << 30
    """Of all files in the folder."""
    max_uploads: int = 4
    """Uploads in progress."""
    upload_idle_s: float = 60.0
    """How long a client may say nothing in the middle of an upload."""
    clip_dirs: tuple[Path, ...] = ()
    """Folders whose clips clients may have reconstructed by naming their path."""
