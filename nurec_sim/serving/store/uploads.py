"""The folder of uploaded scenes and clips: each is received under a hidden name, checked, then renamed.

A hidden file ``.incoming-<random>.<ending>`` is owned by the process that receives it (``owned_files``): what a killed
one left is removed by the next that uses the folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from nurec_sim.errors import ArchiveError, RequestError, TooLargeError
from nurec_sim.files.new_files import sync_folder
from nurec_sim.serving.store.owned_files import owned_file, remove_abandoned
from nurec_sim.serving.store.sources import identify, is_archive
from nurec_sim.serving.store.store import SceneStore

log = logging.getLogger(__name__)

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,149}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_INCOMING = ".incoming-"
_PLACING = ".placing.lock"


class UploadFolder:
    """Uploaded scenes and clips of a store; those of earlier servers are added at once.

    Args:
        folder: created if it does not exist; for uploads only.
        store: where they are added.
        max_bytes: of one file.
        max_total_bytes: of all files.

    Raises:
        OSError: the folder cannot be made or read.
    """

    def __init__(self, folder: Path, store: SceneStore, *, max_bytes: int, max_total_bytes: int) -> None:
        self.folder, self._store = folder, store
        self._max_bytes, self._max_total_bytes = max_bytes, max_total_bytes
        folder.mkdir(parents=True, exist_ok=True)
        for path in [*folder.glob(f"{_INCOMING}*"), folder / _PLACING]:
            if remove_abandoned(path):
                log.warning("removed what an interrupted upload left: %s", path)
        for path in self.files:
            store.add(path)

    @property
    def files(self) -> list[Path]:
        """Complete files, sorted."""
        return sorted(p for p in self.folder.iterdir() if p.suffix in (".usdz", ".zip") and not p.name.startswith("."))

    @property
    def total_bytes(self) -> int:
        """Size of all files; incomplete ones count with their announced size."""
        total = 0
        for path in self.folder.iterdir():
            with contextlib.suppress(FileNotFoundError):  # it arrived, or was cancelled, at this moment
                total += path.stat().st_size
        return total

    @contextlib.contextmanager
    def receive(self, name: str, size: int, sha256: str, ending: str) -> Iterator[Upload]:
        """Receives a file; if the block ends before ``Upload.finish``, it is removed.

        Args:
            name: file name.
            size: bytes that will come.
            sha256: of them, hexadecimal.
            ending: that the name must have: ``.usdz`` or ``.zip``.

        Raises:
            RequestError: an invalid name, size or hash; the text says which.
            TooLargeError: the file exceeds a limit or the free disk space.
        """
        check_name(name, ending)
        if not _SHA256.fullmatch(sha256):
            raise RequestError(f"sha256 must have 64 hexadecimal digits in lower case, got {sha256[:100]!r}")
        if size < 1:
            raise RequestError("size is missing: the bytes of the whole file")
        if size > self._max_bytes:
            raise TooLargeError(f"an upload may have {self._max_bytes:,} bytes, got {size:,}")
        if (total := self.total_bytes + size) > self._max_total_bytes:
            raise TooLargeError(f"uploads may take {self._max_total_bytes:,} bytes in all, with this one {total:,}")
        with disk_errors():
            if size > (free := shutil.disk_usage(self.folder).free):
                raise TooLargeError(f"the server's disk has {free:,} bytes left, the upload has {size:,}")
        self._refuse_taken(name)
        hidden = self.folder / f"{_INCOMING}{secrets.token_hex(8)}{ending}"
        with owned_file(hidden, lambda: None) as handle, os.fdopen(handle, "wb", closefd=False) as file:
            with disk_errors():
                os.truncate(handle, size)  # so that it counts for whoever comes next
            yield Upload(self, file, hidden, self.folder / name, size, sha256)

    def place(self, hidden: Path, target: Path) -> str:
        """Renames a complete file and adds its scene, whose id it returns."""
        new_id = identify(hidden).id
        if new_id in self._store.ids:
            raise ArchiveError(f"{target.name}: a scene of id {new_id!r} is already served")
        with owned_file(self.folder / _PLACING, lambda: None):
            self._refuse_taken(target.name)
            os.replace(hidden, target)
            sync_folder(self.folder)
        try:
            return self._store.offer(target)
        except BaseException:
            target.unlink()
            raise

    def holds(self, path: object) -> bool:
        """Whether a source is a file of this folder."""
        return isinstance(path, Path) and path.parent == self.folder

    def delete(self, name: str) -> int:
        """Removes an uploaded scene and deletes its file; returns the bytes of memory freed.

        Raises:
            UnknownSceneError, ArchiveError: see ``SceneStore.resolve``.
            RequestError: it was not uploaded.
            SceneInUseError: it is in use.
        """
        source = self._store.source(name)
        if not self.holds(source.origin):
            raise RequestError(f"scene {source.id!r} was not uploaded, so it cannot be deleted")
        freed = self._store.remove(source.id)
        assert isinstance(source.origin, Path)
        source.origin.unlink(missing_ok=True)
        return freed

    def _refuse_taken(self, name: str) -> None:
        if (self.folder / name).exists():
            raise RequestError(f"a file {name!r} was uploaded before; choose another name, or delete its scene first")


class Upload:
    """One file being received; made by ``UploadFolder.receive``.

    Args:
        folder: where it belongs.
        file: open hidden file.
        hidden: its path.
        target: its path when it is complete.
        size: announced bytes.
        sha256: announced hash, hexadecimal.
    """

    def __init__(
        self, folder: UploadFolder, file: BinaryIO, hidden: Path, target: Path, size: int, sha256: str
    ) -> None:
        self._folder, self._file, self._hidden, self._target = folder, file, hidden, target
        self._size, self._sha256 = size, sha256
        self._digest, self._received = hashlib.sha256(), 0

    def write(self, data: bytes) -> None:
        """Writes the next bytes.

        Raises:
            RequestError: more bytes than announced.
            TooLargeError: the disk is full.
        """
        self._received += len(data)
        if self._received > self._size:
            raise RequestError(f"the file has more bytes than the {self._size:,} that the header announced")
        self._digest.update(data)
        with disk_errors():
            self._file.write(data)

    def finish(self) -> str:
        """Checks and renames the file and adds its scene, whose id it returns.

        Raises:
            RequestError: the bytes are not those that the header announced.
            ArchiveError, ClipError: it cannot be opened, or its id is taken.
            TooLargeError: the disk is full.
        """
        if self._received != self._size:
            raise RequestError(f"the header announced {self._size:,} bytes, {self._received:,} came")
        if self._digest.hexdigest() != self._sha256:
            raise RequestError(f"the bytes have sha256 {self._digest.hexdigest()}, the header announced {self._sha256}")
        with disk_errors():
            self._file.flush()
            os.fsync(self._file.fileno())
        try:
            if is_archive(self._hidden):
                from nurec_sim.scene import read_scene

                read_scene(self._hidden)
            with disk_errors():
                return self._folder.place(self._hidden, self._target)
        except ArchiveError as error:  # clients know the file by its own name
            raise ArchiveError(str(error).replace(str(self._hidden), self._target.name)) from error


def check_name(name: str, ending: str = "") -> None:
    """Refuses names that clients may not give to files and scenes.

    Raises:
        RequestError: the text says what is allowed.
    """
    if not _NAME.fullmatch(name) or not name.endswith(ending):
        end = f" and end in {ending}" if ending else ""
        raise RequestError(
            f"name must have up to 150 letters, digits, '_', '-' and '.', begin with none of the last two{end}, "
            f"got {name[:200]!r}"
        )


@contextlib.contextmanager
def disk_errors() -> Iterator[None]:
    """Turns errors of the disk into one for the client."""
    try:
        yield
    except OSError as error:
        log.warning("an upload could not be written: %s", error)
        raise TooLargeError(f"the server cannot keep the upload: {error.strerror or error}") from error
