"""Which files are scenes, and who reads each."""

from __future__ import annotations

from pathlib import Path

from nurec_sim.files.zip_package import Package
from nurec_sim.scene.archive import MANIFEST, read_archive
from nurec_sim.scene.interop.reader import read_foreign
from nurec_sim.types import GaussianScene

FOREIGN_SUFFIXES = (".ply", ".spz", ".usd", ".usda", ".usdc", ".nurec", ".ckpt")
SCENE_SUFFIXES = (".usdz", *FOREIGN_SUFFIXES)
"""Names of files that ``read_scene`` opens end in one of these, in capitals or not."""


def read_scene(path: Path | str) -> GaussianScene:
    """Reads a scene: an archive of ours (``read_archive``), or what another program wrote (``read_foreign``).

    Raises:
        ArchiveError: not a scene, damaged, changed since it was written, unsafe, or not sound.
    """
    path = Path(path)
    return read_foreign(path) if is_foreign(path) else read_archive(path)


def is_foreign(path: Path) -> bool:
    """Whether another program wrote a file of a scene: it has no manifest of ours.

    Raises:
        ArchiveError: the file is no readable archive.
    """
    if path.suffix.lower() in FOREIGN_SUFFIXES:
        return True
    with Package(path) as package:
        return MANIFEST not in package.names
