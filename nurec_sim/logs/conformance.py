"""Conformance test for authors of log readers, on a log of the reader's format.

::

    from nurec_sim.logs import check_reader
    print(check_reader("my_log", MyReader()))      # [] when all is well
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from nurec_sim import plugins
from nurec_sim.errors import ClipError
from nurec_sim.logs.check import check_clip
from nurec_sim.logs.checks import measure_clip
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.reader import open_clip, read_tables
from nurec_sim.types import LogReader


def check_reader(path: str | Path, reader: LogReader) -> list[str]:
    """Opens a log with a reader and lists violations of the interface; empty if it conforms.

    Checks that the reader has all its members; that it recognises the log, but neither an empty folder nor a text file;
    that opening an empty folder raises a ``ClipError``; that the log opens and its tables are valid; that every image
    and sweep can be read, also concurrently, with the same result each time; and that ground, cameras, LiDARs and boxes
    are consistent (``measure_clip``, which detects inverted or rotated calibrations).
    """
    faults = [f"it lacks {text}" for text in plugins.lacking(plugins.LOG_READERS, reader)]
    if faults:
        return faults
    faults += [f"{name} must not be empty" for name in ("name", "description") if not getattr(reader, name).strip()]
    faults += _foreign_faults(reader)
    if (answer := _answer(lambda: reader.can_open(Path(path)))) is not True:
        faults.append(f"can_open must answer True for the log, got {answer}")
    try:
        clip, again = read_tables(path, reader), open_clip(path, reader)
    except ClipError as error:
        return [*faults, f"the log does not open: {error}"]
    faults += check_clip(clip) or _twice_faults(clip, again)
    return faults + [fault for measure in measure_clip(clip) for fault in measure.faults]


def _answer(call: Callable[[], object]) -> object:
    """The result of a call, or its exception as text."""
    try:
        return call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _foreign_faults(reader: LogReader) -> Iterator[str]:
    """Faults in the handling of paths that are not logs of its format."""
    with tempfile.TemporaryDirectory() as folder:
        empty, text = Path(folder, "empty"), Path(folder, "file.txt")
        empty.mkdir()
        text.write_text("no log\n")
        for path, what in ((empty, "an empty folder"), (text, "a text file")):
            if (answer := _answer(lambda path=path: reader.can_open(path))) is not False:  # type: ignore[misc]
                yield f"can_open must answer False for {what}, got {answer}"
        try:
            reader.open(empty)
            yield "open must raise a ClipError for an empty folder, and did not"
        except ClipError:
            pass
        except Exception as error:
            yield f"open must raise a ClipError for an empty folder, got {type(error).__name__}: {error}"


def _twice_faults(clip: Clip, again: Clip) -> Iterator[str]:
    """Differences between a log that is opened twice and read from several threads."""
    if not np.array_equal(clip.ego.world_from_body, again.ego.world_from_body) or clip.span_us != again.span_us:
        yield "opening the log twice gives other poses or times"
    images = [(name, index) for name in clip.rig.cameras for index in range(min(3, clip.frame_count(name)))]
    sweeps = [(name, index) for name in clip.rig.lidars for index in range(min(3, clip.sweep_count(name)))]
    with ThreadPoolExecutor(4) as pool:
        for (name, index), image in zip(images, pool.map(lambda key: again.image(*key), images), strict=True):
            if not np.array_equal(clip.image(name, index), image):
                yield f"camera {name!r} frame {index}: another image when read again"
        for (name, index), sweep in zip(sweeps, pool.map(lambda key: again.sweep(*key), sweeps), strict=True):
            if not np.array_equal(clip.sweep(name, index).xyz_m, sweep.xyz_m):
                yield f"LiDAR {name!r} sweep {index}: other points when read again"
    for name in clip.rig.cameras:
        if isinstance(answer := _answer(lambda name=name: clip.ego_mask(name)), str):  # type: ignore[misc]
            yield answer
