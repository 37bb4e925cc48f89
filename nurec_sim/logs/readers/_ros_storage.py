"""The messages of a ROS 2 bag: one or more .mcap or .db3 (SQLite) files, read message by message."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
import weakref
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

import yaml

from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs.readers import _ros_messages as messages
from nurec_sim.logs.readers._packages import clip_errors, package

METADATA = "metadata.yaml"
_INFORMATION = b"rosbag2_bagfile_information"
SUFFIXES = (".mcap", ".db3")
_INFORMATION_WITHIN = 4096
HEADER_BYTES = 512
Key = tuple[int, ...]


class BagFile(Protocol):
    """One file of a bag."""

    topics: dict[str, str]
    """Type of each topic whose messages can be decoded."""

    def scan(self, whole: Collection[str], starts: Collection[str]) -> Iterator[tuple[str, Key, bytes]]:
        """Topic, key and bytes of the messages of some topics, ``starts``: of their first bytes at least."""
        ...

    def read(self, topic: str, key: Key) -> bytes:
        """The bytes of one message."""
        ...


def is_bag(path: Path) -> bool:
    """Whether it is a bag, from names and the start of ``metadata.yaml``."""
    if path.is_dir():
        try:
            with (path / METADATA).open("rb") as file:
                return _INFORMATION in file.read(_INFORMATION_WITHIN)
        except OSError:
            return False
    return path.suffix in SUFFIXES and path.is_file()


def open_files(path: Path) -> list[BagFile]:
    """The files of a bag, in order.

    Raises:
        ClipError: one is missing, compressed as a whole, or damaged.
    """
    return [_open(each) for each in (_listed(path) if path.is_dir() else [path])]


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file that holds keys and values.

    Raises:
        ClipError: it is missing, too large, or not such a file.
    """
    try:
        if (size := path.stat().st_size) > LIMITS.yaml_bytes:
            raise ClipError(f"{path.name} has {size:,} bytes; {LIMITS.yaml_bytes:,} are allowed")
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise ClipError(f"{path.name} is not readable YAML: {error}") from error
    if not isinstance(content, dict):
        raise ClipError(f"{path.name} must hold keys and values, got {type(content).__name__}")
    return content


def _listed(folder: Path) -> list[Path]:
    information = read_yaml(folder / METADATA).get("rosbag2_bagfile_information")
    information = information if isinstance(information, dict) else {}
    names = information.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ClipError(f"{METADATA}: relative_file_paths must list the files of the bag, got {names}")
    # Some recorders write the name of the folder as well.
    files = [folder / Path(name).name for name in names]
    for file in files:
        if file.suffix not in SUFFIXES:
            raise ClipError(f"{METADATA}: {file.name} cannot be read; files must end in {' or '.join(SUFFIXES)}")
        if not file.is_file():
            raise ClipError(f"{METADATA}: {file.name} is missing")
    if str(information.get("compression_mode")).upper() == "MESSAGE":
        raise ClipError(f"{METADATA}: single messages are compressed, which is not supported; chunks of .mcap may be")
    return files


def _open(file: Path) -> BagFile:
    with _damage(file):
        return McapFile(file) if file.suffix == ".mcap" else SqliteFile(file)


def _damage(file: Path) -> AbstractContextManager[None]:
    advice = "; the command 'mcap recover' mends recordings that were cut off" if file.suffix == ".mcap" else ""
    return clip_errors(f"{file.name} is damaged", advice)


class McapFile:
    """An .mcap file; keys are log times and the place among the topic's messages of that time."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._lock = threading.Lock()  # the reader moves in one stream
        reader = package("mcap.reader", messages.EXTRA, messages.FORMAT)
        stream = file.open("rb")
        weakref.finalize(self, stream.close)
        self._reader = reader.make_reader(stream)
        summary = self._reader.get_summary()
        if summary is None:
            raise ClipError(f"{file.name} has no index; the command 'mcap recover' adds one")
        self.topics = {
            channel.topic: summary.schemas[channel.schema_id].name
            for channel in summary.channels.values()
            if channel.message_encoding == "cdr" and channel.schema_id in summary.schemas
        }

    def scan(self, whole: Collection[str], starts: Collection[str]) -> Iterator[tuple[str, Key, bytes]]:
        """See ``BagFile``."""
        count: Counter[tuple[str, int]] = Counter()
        with self._lock, _damage(self._file):
            for _, channel, message in self._reader.iter_messages([*whole, *starts], log_time_order=False):
                at = channel.topic, message.log_time
                yield channel.topic, (message.log_time, count[at]), message.data
                count[at] += 1

    def read(self, topic: str, key: Key) -> bytes:
        """See ``BagFile``."""
        time, number = key
        with self._lock, _damage(self._file):
            found = self._reader.iter_messages([topic], starting_at=time, ending_at=time, log_time_order=False)
            for index, (_, _, message) in enumerate(found):
                if index == number:
                    return bytes(message.data)
        raise ClipError(f"{self._file.name}: a message of {topic} is gone")


class SqliteFile:
    """A .db3 file; keys are row numbers."""

    def __init__(self, file: Path) -> None:
        self._file = file
        with self._connection() as connection:
            rows = connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        self._ids = {name: id for id, name, _, format in rows if format == "cdr"}
        self.topics = {name: kind for _, name, kind, format in rows if format == "cdr"}

    @contextlib.contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        # Read only, and one for each use: connections belong to the thread that opened them.
        connection = sqlite3.connect(f"{self._file.absolute().as_uri()}?mode=ro", uri=True)
        try:
            with _damage(self._file):
                yield connection
        finally:
            connection.close()

    def scan(self, whole: Collection[str], starts: Collection[str]) -> Iterator[tuple[str, Key, bytes]]:
        """See ``BagFile``."""
        for topics, column in ((whole, "data"), (starts, f"substr(data, 1, {HEADER_BYTES})")):
            for topic in topics:
                if topic not in self._ids:
                    continue
                query = f"SELECT id, {column} FROM messages WHERE topic_id = ? ORDER BY timestamp, id"
                with self._connection() as connection:
                    for row, data in connection.execute(query, (self._ids[topic],)):
                        yield topic, (row,), bytes(data)

    def read(self, topic: str, key: Key) -> bytes:
        """See ``BagFile``."""
        with self._connection() as connection:
            row = connection.execute("SELECT data FROM messages WHERE id = ?", key).fetchone()
        if row is None:
            raise ClipError(f"{self._file.name}: a message of {topic} is gone")
        return bytes(row[0])
