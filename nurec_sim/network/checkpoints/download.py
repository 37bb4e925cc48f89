"""Where the weights of a profile are: given, named by the environment, shipped, or fetched before."""

from __future__ import annotations

import hashlib
import importlib
import os
from pathlib import Path
from types import ModuleType

from nurec_sim.errors import WeightsError, WriteError
from nurec_sim.files.new_files import writing
from nurec_sim.network.checkpoints.released import RELEASED, ReleasedFile
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.network.profiles import PROFILES

CHECKPOINT_VARIABLE = "INSTANT_NUREC_FULL_PT"
"""Environment variable that names a weights file, used for any requested profile."""

_SHIPPED = Path(__file__).parents[1] / "weights"


def find_weights(profile: str, checkpoint: Path | None = None) -> Path:
    """The weights file to load. Downloads nothing.

    The first of these that there is: ``checkpoint``; the file that ``$INSTANT_NUREC_FULL_PT`` names; the file that is
    part of this package; the released file in the cache of Hugging Face, if its size is right.

    Raises:
        WeightsError: no such profile, a named file is not there, or the profile has no weights on this machine; the
            text says how to get them.
    """
    if profile not in {**PROFILES, **LIDAR_PROFILES}:
        raise WeightsError(f"no network profile {profile!r}; have {[*PROFILES, *LIDAR_PROFILES]}")
    if checkpoint is not None:
        if not Path(checkpoint).is_file():
            raise WeightsError(f"no weights at {str(checkpoint)!r}")
        return Path(checkpoint)
    if named := os.environ.get(CHECKPOINT_VARIABLE):
        if not Path(named).is_file():
            raise WeightsError(f"${CHECKPOINT_VARIABLE} names {named!r}, which is no file; correct or unset it")
        return Path(named)
    if (shipped := shipped_weights(profile)) is not None:
        return shipped
    if profile not in RELEASED:
        raise WeightsError(
            f"weights of '{profile}' are not part of this version, and none are published; "
            "give --checkpoint PATH, or --random-weights SEED to try the chain without"
        )
    released = RELEASED[profile]
    path = cached_file(released)
    if path is None:
        raise WeightsError(
            f"weights of '{profile}' are not on this machine; `nurec-sim weights fetch {profile}` gets them "
            f"({released.size_bytes / 1e6:,.0f} MB), or give --checkpoint PATH"
        )
    verify_file(path, released, digest=False)
    return path


def shipped_weights(profile: str) -> Path | None:
    """The weights of a profile that come with this package, if they do."""
    path = _SHIPPED / f"{profile}.safetensors"
    return path if path.is_file() else None


def cached_file(released: ReleasedFile, revision: str | None = None) -> Path | None:
    """A released file in the cache of Hugging Face (``$HF_HOME``); None where it, or the library, is missing."""
    try:
        hub = hub_library()
    except WeightsError:
        return None
    found = hub.try_to_load_from_cache(released.repository, released.filename, revision=revision or released.revision)
    return Path(found) if isinstance(found, str) else None


def fetch(released: ReleasedFile, revision: str | None = None, folder: Path | None = None) -> Path:
    """Download a released file, or find it in the cache, and check its size and digest.

    The library shows progress, resumes interrupted downloads and makes the file appear when it is complete.

    Args:
        released: which file.
        revision: commit, tag or branch; the file's own if not given.
        folder: where to put it; the cache of Hugging Face (``$HF_HOME``) if not given.

    Raises:
        WriteError: the disk is full, or the folder cannot be written.
        WeightsError: the extra 'hub' is not installed, the file cannot be had, or it is not the released one. A file of
            the right size and the wrong digest is removed.
    """
    hub = hub_library()
    try:
        with writing(folder or "the cache of Hugging Face ($HF_HOME)"):
            path = hub.hf_hub_download(
                released.repository, released.filename, revision=revision or released.revision, local_dir=folder
            )
    except WriteError:
        raise
    except Exception as error:  # its errors have no base in common: network, access, revision, disk
        first_line = str(error).strip().split("\n")[0]
        raise WeightsError(
            f"cannot get {released.filename} from {released.repository}: {first_line} Without a network, copy the file "
            "from a machine that has one and give it with --checkpoint PATH"
        ) from error
    try:
        verify_file(Path(path), released)
    except WeightsError:
        if Path(path).stat().st_size == released.size_bytes:  # later only the size is looked at, so it must not stay
            _remove(Path(path))
        raise
    return Path(path)


def verify_file(path: Path, released: ReleasedFile, *, digest: bool = True) -> None:
    """Check that a file is a released one.

    Args:
        path: the file.
        released: which one it should be.
        digest: whether to compare the SHA-256 too, if one is published; takes seconds.

    Raises:
        WeightsError: it is not.
    """
    size = path.stat().st_size
    if size != released.size_bytes:
        raise WeightsError(
            f"{path} has {size:,} bytes, the released file of '{released.name}' {released.size_bytes:,}; "
            "delete it and fetch again, or, if you trust it, give it with --checkpoint"
        )
    if digest and released.sha256 is not None and (found := sha256(path)) != released.sha256:
        raise WeightsError(
            f"{path} has SHA-256 {found}, the released file of '{released.name}' {released.sha256}; it is damaged or "
            "another file"
        )


def _remove(path: Path) -> None:
    """Remove a file and, where it is a link into the cache, what it points to."""
    path.resolve().unlink()
    path.unlink(missing_ok=True)


def sha256(path: Path) -> str:
    """Digest of a file as hexadecimal text."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hub_library() -> ModuleType:
    """The package ``huggingface_hub``.

    Raises:
        WeightsError: it is not installed.
    """
    try:
        return importlib.import_module("huggingface_hub")
    except ImportError:
        raise WeightsError(
            "downloading needs the extra 'hub': pip install 'nurec-sim[hub]'; "
            "or download the file by other means and give it with --checkpoint PATH"
        ) from None
