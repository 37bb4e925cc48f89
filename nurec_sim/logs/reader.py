"""Opens logs: finds the reader of their format, and validates poses and times."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from nurec_sim import plugins
from nurec_sim.errors import ClipError, NurecSimError, UnknownFormatError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.clocks import with_image_clocks
from nurec_sim.logs.consistency import EARLIEST_US, table_faults
from nurec_sim.logs.moved import later
from nurec_sim.logs.origins import with_origins
from nurec_sim.logs.storage import is_cut_zip
from nurec_sim.types import LogReader

SECOND_US = 1_000_000
_NAMES_SHOWN = 8
_CUT_SHORT = ", a .zip that is cut short or damaged"


def open_clip(path: str | Path, reader: LogReader | str | None = None) -> Clip:
    """Open a driving log. Images and sweeps are read on demand.

    All times of a log that starts before 1 000 000 us, for instance at 0, are shifted by whole seconds, so that it
    starts within the second from there; ``Clip.time_offset_us`` is the shift.

    Args:
        path: a file or folder of any supported format; for formats that keep several logs in a folder, the folder
            followed by the name of one, as in ``nuscenes/scene-0061``.
        reader: a reader, or a reference to one for ``plugins.load``; None selects the first that recognises the log.

    Raises:
        ClipError: nothing there, an unknown format, a corrupt file, or inconsistent poses and times; the text names the
            file and the location. ``check_clip`` lists all faults of a clip.
    """
    clip = read_tables(path, reader)
    if faults := table_faults(clip):
        raise ClipError(f"{Path(path).name}: {faults[0]}")
    return clip


def read_tables(path: str | Path, reader: LogReader | str | None = None) -> Clip:
    """A clip whose poses and times are read but not validated; arguments as for ``open_clip``.

    Raises:
        ClipError: nothing there, an unknown format, or a corrupt file.
    """
    path = Path(path)
    if reader is None:
        reader = find_reader(path)
    elif isinstance(reader, str):
        reader = plugins.load(plugins.LOG_READERS, reader)
    if not path.exists() and not reader.can_open(path):
        raise _nothing_at(path)
    try:
        clip = reader.open(path)
    except ClipError as error:
        # The reader's text may begin with the log's name already.
        raise error if str(error).startswith(f"{path.name}: ") else ClipError(f"{path.name}: {error}") from None
    except Exception as error:
        raise ClipError(f"{path.name}: log reader {reader.name!r} failed: {type(error).__name__}: {error}") from error
    if not isinstance(clip, Clip):
        raise ClipError(
            f"{path.name}: log reader {reader.name!r} must return a nurec_sim.logs.Clip, got {type(clip).__name__}"
        )
    clip.path, clip.format = path, reader.name
    return with_image_clocks(with_origins(_late_enough(clip)))


def is_log(path: Path) -> bool:
    """Whether a reader can open a file or folder."""
    try:
        find_reader(path)
    except ClipError:
        return False
    return True


def find_reader(path: Path) -> LogReader:
    """The first reader that can open a log, shipped ones first.

    A reader that cannot be loaded, or whose ``can_open`` fails, is skipped with a warning.

    Raises:
        ClipError: the log is damaged, or of an unknown format; the text lists the known ones.
    """
    damaged: ClipError | None = None
    known, broken = [], []
    for name, reader in plugins.load_all(plugins.LOG_READERS):
        if isinstance(reader, NurecSimError):
            broken.append(str(reader))
            continue
        known.append(f"{reader.name}: {reader.description}")
        try:
            if reader.can_open(path):
                for text in broken:
                    warnings.warn(text, RuntimeWarning, stacklevel=2)
                return reader
        except ClipError as error:
            # Another reader may know the log; the error is raised only if none does.
            damaged = damaged or error
        except Exception as error:
            broken.append(f"log reader '{name}' cannot look at {path.name}: {type(error).__name__}: {error}")
    if damaged is not None:
        raise damaged
    if not path.exists():
        raise _nothing_at(path)
    raise UnknownFormatError(
        f"{path.name}: no log reader knows this format; it is {_looks(path)}. Known are\n"
        + "".join(f"  {line}\n" for line in [*known, *broken])
        + "docs/log_formats.md describes them, docs/write_a_log_reader.md says how to read others"
    )


@runtime_checkable
class _KnowsFiles(Protocol):
    """A reader of a format whose logs also depend on files beside their path, such as a calibration for all logs."""

    def files(self, path: Path) -> Sequence[Path]: ...


def log_files(path: Path) -> Sequence[Path]:
    """Files and folders that a log depends on: its path, and what its reader names in ``files(path)``, if it has that.

    A path that no reader can open stands for itself.
    """
    try:
        reader = find_reader(path)
        return reader.files(path) if isinstance(reader, _KnowsFiles) else [path]
    except ClipError:
        return [path]


def _nothing_at(path: Path) -> ClipError:
    return ClipError(f"no clip at {str(path)!r}: give a log, such as a clip folder or a .zip of one")


def _looks(path: Path) -> str:
    """A short description of what is at a path."""
    if path.suffix.lower() == ".usdz":
        return "a scene archive, which a reconstruction of a log is"
    if not path.is_dir():
        return f"a file of {path.stat().st_size:,} bytes{_CUT_SHORT if is_cut_zip(path) else ''}"
    names = sorted(each.name for each in path.iterdir())
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    return f"a folder with {', '.join(names[:_NAMES_SHOWN])}{more}" if names else "an empty folder"


def _late_enough(clip: Clip) -> Clip:
    """The clip, shifted to later times by whole seconds if it starts too early.

    Clients encode times as unsigned integers, and request frames from half a second before the first.
    """
    seconds = -((clip.span_us[0] - EARLIEST_US) // SECOND_US)
    return later(clip, seconds * SECOND_US) if seconds > 0 else clip
