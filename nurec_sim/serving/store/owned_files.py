"""Files owned by one process, so that files left by a killed process can be recognised and removed.

Ownership is an advisory lock of the system (``flock``), which ends with its process, whatever ends that. Process ids in
the files are for people only: ids come again, and mean nothing in another container that shares the folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

_POLL_S = 0.1


@contextlib.contextmanager
def owned_file(path: Path, waiting: Callable[[], None]) -> Iterator[int]:
    """Creates a file and owns it until the block ends, which removes it; yields its handle.

    Waits while another process, or another block of this one, owns it.

    Args:
        path: the file; its folder is made if need be.
        waiting: called repeatedly while waiting; what it raises ends the wait.

    Raises:
        OSError: the file cannot be made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while (handle := _take(path, os.O_RDWR | os.O_CREAT)) is None:
        waiting()
        time.sleep(_POLL_S)
    try:
        yield handle
    finally:
        path.unlink(missing_ok=True)  # before the lock ends: who takes it next must see that this file is gone
        os.close(handle)


def remove_abandoned(path: Path) -> bool:
    """Removes a file of ``owned_file`` that no process owns; returns whether it did."""
    try:
        handle = _take(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    if handle is None:
        return False
    path.unlink(missing_ok=True)
    os.close(handle)
    return True


def _take(path: Path, flags: int) -> int | None:
    """A handle that holds the lock of the file, or None if another process does."""
    handle = os.open(path, flags, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Its last owner may have removed it between the two calls: a lock on a file without a name protects nothing.
        if os.path.samestat(os.fstat(handle), os.stat(path)):
            return handle
    except (BlockingIOError, FileNotFoundError):
        pass
    except BaseException:
        os.close(handle)
        raise
    os.close(handle)
    return None
