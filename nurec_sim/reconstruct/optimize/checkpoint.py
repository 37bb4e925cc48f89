"""The state of an optimisation on disk: NumPy arrays in one file, which is replaced as a whole."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nurec_sim.errors import ReconstructError
from nurec_sim.files.new_files import new_file

KEY = "key"


def write_checkpoint(path: Path, key: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a state; a kill leaves the previous one.

    Args:
        path: the file.
        key: of what is optimised and how: a state fits no other.
        arrays: the state.

    Raises:
        WriteError: the file cannot be written.
    """
    with new_file(path) as file:
        np.savez(file, **{KEY: np.array(key), **arrays})  # type: ignore[arg-type]


def read_checkpoint(path: Path, key: str) -> dict[str, np.ndarray]:
    """The arrays of a state.

    Raises:
        ReconstructError: no such file, a damaged one, or a state of another optimisation.
    """
    if not path.is_file():
        raise ReconstructError(f"nothing to resume: there is no {path}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        found = str(arrays.pop(KEY))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise ReconstructError(f"{path} is not the state of an optimisation: {error}") from None
    if found != key:
        raise ReconstructError(
            f"{path} belongs to another optimisation: the log, the method, the cameras or the settings differ; "
            "resume with those it was started with"
        )
    return arrays
