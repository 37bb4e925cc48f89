"""Scene file formats and their readers."""

from __future__ import annotations

from pathlib import Path

from nurec_sim.files.zip_package import Package
from nurec_sim.scene.archive import MANIFEST, read_archive
from nurec_sim.scene.interop.reader import read_foreign
from nurec_sim.types import GaussianScene

FOREIGN_SUFFIXES = (".ply", ".spz", ".usd", ".usda", ".usdc", ".nurec", ".ckpt")
SCENE_SUFFIXES = (".usdz", *FOREIGN_SUFFIXES)
"""File suffixes that ``read_scene`` supports, case-insensitive."""


def read_scene(path: Path | str) -> GaussianScene:
    """Reads a scene: an archive of ours (``read_archive``), or a third-party scene (``read_foreign``).

    Raises:
        ArchiveError: not a scene, damaged, modified, unsafe, or invalid.
    """
    path = Path(path)
    return read_foreign(path) if is_foreign(path) else read_archive(path)


def is_foreign(path: Path) -> bool:
    """Whether a scene file is third-party, that is without our manifest.

    Raises:
        ArchiveError: the file is not a readable archive.
    """
    if path.suffix.lower() in FOREIGN_SUFFIXES:
        return True
    with Package(path) as package:
        return MANIFEST not in package.names
