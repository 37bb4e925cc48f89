"""Download cache of scene archives by URL; complete files only, least recently used ones are removed first."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import os
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

from nurec_sim.errors import RequestError, TooLargeError

_CHUNK = 1 << 20
_STALL_S = 30.0
_ABANDONED_S = 86_400.0
_ZIP_START = b"PK\x03\x04"
_OURS = "[0-9a-f]" * 32 + ".usdz"
"""Names of downloaded files; other files in the folder are left alone."""


class DownloadCache:
    """Downloaded archives are reused, also by later processes.

    A file is written under another name, flushed to the disk and renamed, so that whatever carries its name is whole.

    Args:
        folder: created on first use.
        capacity: files kept.
        max_bytes: of one file.
        timeout_s: for one file.
    """

    def __init__(self, folder: Path, capacity: int, max_bytes: int, timeout_s: float) -> None:
        self.folder = folder
        self._capacity, self._max_bytes, self._timeout_s = capacity, max_bytes, timeout_s

    def path_of(self, url: str) -> Path:
        """Path of the archive of a URL, whether or not it exists."""
        return self.folder / f"{hashlib.sha256(url.encode()).hexdigest()[:32]}.usdz"

    def fetch(self, url: str) -> Path:
        """The archive at an ``http(s)://`` URL, from the folder or from the web.

        Raises:
            RequestError: it cannot be fetched or kept, in time, or is no zip archive.
            TooLargeError: it is larger than allowed.
        """
        path = self.path_of(url)
        if path.exists():
            with contextlib.suppress(OSError):
                os.utime(path)  # it is the most recently used one now
            return path
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._remove_abandoned()
            descriptor, name = tempfile.mkstemp(suffix=".part", prefix=".", dir=self.folder)
            part = Path(name)
            try:
                with open(descriptor, "wb") as file:
                    self._download(url, file)
                    file.flush()
                    os.fsync(file.fileno())
                os.replace(part, path)
            finally:
                part.unlink(missing_ok=True)
        except (OSError, ValueError, http.client.HTTPException) as error:  # urllib's own errors are OSErrors
            if isinstance(error, urllib.error.HTTPError):
                error.close()  # it is the connection, too
            raise RequestError(f"the scene at {url} cannot be fetched: {error}") from error
        return path

    def make_room(self) -> list[Path]:
        """Removes files beyond the capacity and returns their paths; open files can still be read."""
        kept = sorted(self.folder.glob(_OURS), key=_last_use, reverse=True)
        removed = kept[self._capacity :]
        for path in removed:
            path.unlink(missing_ok=True)
        return removed

    def _download(self, url: str, file) -> None:
        end = time.monotonic() + self._timeout_s
        request = urllib.request.Request(url, headers={"Accept-Encoding": "identity"})
        with _opener().open(request, timeout=min(_STALL_S, self._timeout_s)) as reply:
            said = reply.headers.get("Content-Length", "")
            if said.isdigit() and int(said) > self._max_bytes:
                raise self._too_large(url, int(said))
            done, start = 0, b""
            while chunk := reply.read1(_CHUNK):  # what has arrived, without waiting for a full chunk
                start = (start + chunk)[:8]
                if not start.startswith(_ZIP_START[: len(start)]):
                    raise RequestError(f"what is at {url} is no .usdz archive: it begins with {start!r}")
                done += len(chunk)
                if done > self._max_bytes:
                    raise self._too_large(url, done)
                if time.monotonic() > end:
                    raise RequestError(f"the scene at {url} did not arrive within {self._timeout_s:g} s")
                file.write(chunk)
        if said.isdigit() and done != int(said) or not done:
            raise RequestError(f"the scene at {url} broke off after {done:,} of {said or 'unknown'} bytes")

    def _too_large(self, url: str, size: int) -> TooLargeError:
        return TooLargeError(f"a scene may have {self._max_bytes:,} bytes; what is at {url} has {size:,} or more")

    def _remove_abandoned(self) -> None:
        """Removes partial files of killed processes."""
        for part in self.folder.glob(".*.part"):
            if time.time() - _last_use(part) > _ABANDONED_S:
                part.unlink(missing_ok=True)


def _last_use(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # removed since it was listed
        return 0.0


def _opener() -> urllib.request.OpenerDirector:
    """Opens web URLs only: neither the URL nor a redirection can name a local file."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler,
        urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPRedirectHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        urllib.request.UnknownHandler,
    ):
        opener.add_handler(handler())
    return opener


def is_web(url: str) -> bool:
    """Whether a URL is a web URL."""
    return urlsplit(url).scheme in ("http", "https")
