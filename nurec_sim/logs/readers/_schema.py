"""What the readers of clip folders share: ``meta.json`` names the format."""

from __future__ import annotations

import abc
from pathlib import Path
from typing import Any

from nurec_sim.logs.clip import Clip
from nurec_sim.logs.storage import META_FILE, Storage, schema_of


class SchemaReader(abc.ABC):
    """Reads a folder, or a .zip of one, whose ``meta.json`` has a certain ``schema`` (``types.LogReader``).

    Attributes:
        name: of the format.
        schema: the value of ``schema`` that it reads.
        description: for messages.
    """

    name: str
    schema: str

    def __init__(self) -> None:
        self.description = f"a folder, or a .zip of one, whose {META_FILE} has the schema {self.schema!r}"

    def can_open(self, path: Path) -> bool:
        """Whether the schema is this reader's."""
        return schema_of(path) == self.schema

    def open(self, path: Path) -> Clip:
        """The clip.

        Raises:
            ClipError: a file or a field is missing or wrong.
        """
        storage = Storage(path)
        return self.read(storage, storage.read_json(META_FILE))

    @abc.abstractmethod
    def read(self, storage: Storage, meta: dict[str, Any]) -> Clip:
        """The clip in a folder or zip file whose ``meta.json`` is given; errors as for ``open``."""
