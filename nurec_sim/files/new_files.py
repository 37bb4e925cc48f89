"""Atomic file writes, and disk errors as one line that names what could not be written."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from nurec_sim.errors import WriteError

_ELSEWHERE, _IN_THE_WAY = "choose another place", "a file lies where a folder should be; choose another place"
_ROOM = f"make room, or {_ELSEWHERE}"
_ADVICE = {
    errno.ENOSPC: _ROOM,
    errno.EDQUOT: _ROOM,
    errno.EFBIG: "more than the file system or the limit of this process (ulimit -f) allows; raise it, or "
    + _ELSEWHERE,
    errno.EROFS: _ELSEWHERE,
    errno.EACCES: "choose a place where you may write",
    errno.EPERM: "choose a place where you may write",
    errno.ENOTDIR: _IN_THE_WAY,
    errno.EEXIST: _IN_THE_WAY,
    errno.EISDIR: "a folder has that name; choose another one",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EIO: f"the disk may be damaged; {_ELSEWHERE}",
}
"""Advice by errno; other errnos are not disk errors and are not converted."""


@contextlib.contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Converts disk errors in the block to a ``WriteError`` that names ``path``; other errors propagate.

    Raises:
        WriteError: the disk is full, the place is read-only or not allowed, a file or a folder is in the way.
    """
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        number = error.errno
        if number is None and "requested and" in str(error):  # numpy's tofile reports a full disk without an errno
            number = errno.ENOSPC
        if number not in _ADVICE:
            raise
        raise WriteError(number, f"{os.strerror(number)}; {_ADVICE[number]}", str(path)) from error


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Opens a temporary file beside ``path`` that is renamed to it when the block succeeds, and removed otherwise.

    Missing folders are created; an existing file is replaced. A device, such as ``/dev/null``, is written directly.

    Raises:
        WriteError: it cannot be written; an existing file is left unchanged.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if path.exists() and not path.is_file():
            with path.open("wb") as device:
                yield device
            return
        # In the same folder, hence on the same file system: only there is the rename atomic.
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                # Contents before the name: otherwise a crash could leave an empty file under the final name.
                os.fsync(file.fileno())
            # mkstemp creates files with mode 0600.
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def swap(ready: Path, path: Path, aside: Path) -> None:
    """Renames ``ready`` to ``path``; what was there moves to ``aside``, which must be free, and back on failure.

    All three lie on one file system, where renaming is atomic; a folder with files in it cannot be replaced at once.
    """
    if path.exists():
        os.rename(path, aside)
    try:
        os.rename(ready, path)
    except OSError:
        if aside.exists():
            os.rename(aside, path)
        raise


def write_file(path: Path, content: bytes | str) -> None:
    """Writes a file atomically; text as UTF-8.

    Raises:
        WriteError: see ``new_file``.
    """
    with new_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder that exists for the duration of the block; disk errors in the block name ``$TMPDIR``.

    Raises:
        WriteError: it cannot be created, or its disk is full.
    """
    try:
        place = tempfile.gettempdir()
    except FileNotFoundError as error:
        reason = "none of the usual places can be written; name one by $TMPDIR"
        raise WriteError(error.errno, reason, "temporary files") from error
    with writing(f"temporary files in {place} ($TMPDIR)"), tempfile.TemporaryDirectory(prefix="nurec_sim_") as folder:
        yield Path(folder)


def check_writable(path: Path, *, folder: bool = False) -> None:
    """Checks that a file or a folder could be written here, before long computations start; creates nothing.

    Raises:
        WriteError: it could not.
    """
    with writing(path):
        place = path.absolute()
        if folder and place.exists() and not place.is_dir():
            _refuse(errno.ENOTDIR)
        if not folder:
            if place.is_dir():
                _refuse(errno.EISDIR)
            place = place.parent
        # The nearest existing folder decides: missing ones below it are created later.
        while not place.exists() and place != place.parent:
            place = place.parent
        if not place.is_dir():
            _refuse(errno.ENOTDIR)
        if not os.access(place, os.W_OK | os.X_OK):
            _refuse(errno.EROFS if os.statvfs(place).f_flag & os.ST_RDONLY else errno.EACCES)


def sync_folder(folder: Path) -> None:
    """Flushes a folder's directory entries to disk, so that they survive a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _refuse(number: int) -> None:
    raise OSError(number, os.strerror(number))
