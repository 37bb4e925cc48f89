"""Disk cache of reconstructions, keyed by content: computed once for all processes.

A reconstruction is written under the lock ``.<key>.lock``, first to ``.<key>.usdz.<anything>.part`` and, once it is
complete and on the disk, renamed to ``<key>.usdz``. A process that dies leaves an unlocked lock file and perhaps
a part; both are removed by the next process that uses the folder.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from nurec_sim.errors import ArchiveError, WriteError
from nurec_sim.files.new_files import writing
from nurec_sim.serving.store.owned_files import owned_file, remove_abandoned
from nurec_sim.serving.store.recipes import Progress, Recipe, content_key
from nurec_sim.types import GaussianScene

log = logging.getLogger(__name__)

_KEY = r".+-[0-9a-f]{24}"
_PART = re.compile(rf"\.({_KEY})\.usdz\..*\.part")
_LOCK = re.compile(rf"\.({_KEY})\.lock")


class ReconstructionCache:
    """The folder of cached reconstructions; leftovers of killed processes are removed at once.

    Args:
        folder: created with the first reconstruction.
        say: called with a line of text when a reconstruction begins.
    """

    def __init__(self, folder: Path, say: Callable[[str], None]) -> None:
        self.folder = folder
        self._say = say
        self._complained = False
        self._remove_leftovers()

    def scene(self, clip_path: Path, recipe: Recipe, progress: Progress) -> GaussianScene:
        """The reconstruction of a clip, from the cache or computed now; the same bits either way.

        A damaged file is computed again. If it cannot be stored (disk full, folder not writable), that is logged once,
        and the scene is returned anyway.

        Args:
            clip_path: the clip.
            recipe: method and settings.
            progress: called with the stage and the fraction done; what it raises cancels the work.

        Raises:
            ClipError, ReconstructError, WeightsError: the clip cannot be reconstructed.
        """
        key = content_key(clip_path, recipe)
        kept = self.folder / f"{key}.usdz"
        if (scene := _read(kept)) is not None:
            return scene
        with ExitStack() as block:
            try:
                waiting = "waiting for another process that reconstructs it"
                with writing(kept):
                    block.enter_context(owned_file(self.folder / f".{key}.lock", lambda: progress(waiting, 0.0)))
            except WriteError as error:
                self._complain(error)
                return self._make(clip_path, recipe, progress)
            if (scene := _read(kept)) is not None:  # made by the one who held the lock
                return scene
            return self._keep(self._make(clip_path, recipe, progress), kept)

    def _make(self, clip_path: Path, recipe: Recipe, progress: Progress) -> GaussianScene:
        self._say(f"reconstructing {clip_path} ({recipe.method}) ...")
        return recipe.reconstruct(clip_path, progress)

    def _keep(self, scene: GaussianScene, kept: Path) -> GaussianScene:
        from nurec_sim.scene import read_scene, write_scene

        try:
            write_scene(scene, kept, overwrite=True)
        except WriteError as error:
            self._complain(error)
            return scene
        return read_scene(kept)

    def _complain(self, error: WriteError) -> None:
        level = logging.DEBUG if self._complained else logging.WARNING
        log.log(level, "a reconstruction could not be kept, the scene is served all the same: %s", error)
        self._complained = True

    def _remove_leftovers(self) -> None:
        try:
            names = [path.name for path in self.folder.iterdir()] if self.folder.is_dir() else []
            keys = {match[1] for name in names if (match := _PART.fullmatch(name) or _LOCK.fullmatch(name))}
            for key in keys:
                self._remove_parts(key, [self.folder / name for name in names if name.startswith(f".{key}.usdz.")])
        except OSError as error:
            log.warning("the folder of kept reconstructions %s could not be tidied: %s", self.folder, error)

    def _remove_parts(self, key: str, parts: list[Path]) -> None:
        lock = self.folder / f".{key}.lock"
        if lock.exists() and not remove_abandoned(lock):
            return  # its owner lives
        for part in parts:
            part.unlink(missing_ok=True)
            log.warning("removed what an interrupted reconstruction left: %s", part)


def _read(kept: Path) -> GaussianScene | None:
    """A cached scene; None if there is none, or it is damaged."""
    from nurec_sim.scene import read_scene

    if not kept.exists():
        return None
    try:
        return read_scene(kept)
    except ArchiveError as error:
        log.warning("made again, its kept reconstruction is damaged: %s", error)
        return None
