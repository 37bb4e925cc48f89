"""Opening a clip: which format it is, and the checks that every clip passes before it is used."""

from __future__ import annotations

from pathlib import Path

from nurec_sim.errors import ClipError
from nurec_sim.logs import fields, native, pack, write
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.consistency import EARLIEST_US, table_faults
from nurec_sim.logs.storage import META_FILE, Storage

SECOND_US = 1_000_000
_READERS = {pack.SCHEMA: pack.read_pack, write.SCHEMA: native.read_native}


def open_clip(path: str | Path) -> Clip:
    """Open a driving log: a clip folder, or a zip file of one. Images and sweeps are read when asked for.

    A log that starts before 1 000 000 us, at 0 for instance, is read with all its times later by whole seconds, so
    that it starts in the second that begins there; ``Clip.time_offset_us`` says by how much.

    Raises:
        ClipError: nothing there, an unknown schema, a broken file, or poses and times that contradict themselves; the
            text names the file and the place. ``check_clip`` lists all faults of a clip.
    """
    clip = read_tables(path)
    faults = table_faults(clip)
    if faults:
        raise ClipError(f"{clip.storage.path.name}: {faults[0]}")
    return clip


def read_tables(path: str | Path) -> Clip:
    """A clip whose poses and times are read but not yet checked against each other.

    Raises:
        ClipError: nothing there, an unknown schema, or a broken file.
    """
    storage = Storage(path)
    if not storage.exists(META_FILE):
        raise ClipError(f"{str(storage.path)!r} has no {META_FILE}; this is not a clip folder")
    meta = storage.read_json(META_FILE)
    name = storage.path.name
    try:
        schema = fields.of_kind(META_FILE, meta, "schema", str)
        if schema not in _READERS:
            raise ClipError(f"unknown clip schema {schema!r}; known are {sorted(_READERS)}")
        return _late_enough(_READERS[schema](storage, meta))
    except ClipError as error:
        # What the storage says begins with the clip's name already.
        raise error if str(error).startswith(f"{name}: ") else ClipError(f"{name}: {error}") from None


def _late_enough(clip: Clip) -> Clip:
    """The clip, put off by whole seconds if it starts too early.

    Times travel as unsigned integers, and clients ask for frames from half a second before the first.
    """
    seconds = -((clip.span_us[0] - EARLIEST_US) // SECOND_US)
    return clip.later(seconds * SECOND_US) if seconds > 0 else clip
