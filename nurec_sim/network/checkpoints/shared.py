"""Weights files that hold only what differs from another file beside them, as profiles that share parts ship.

The metadata name the other file, its SHA-256 and the tensors to take from it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from nurec_sim.errors import WeightsError
from nurec_sim.files.new_files import write_file

KEY = "nurec_sim_shared"


def with_shared(path: Path, own: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of a safetensors file with those that it takes from the file beside it, in the order of their names.

    Raises:
        WeightsError: that file is not there or another one, or it lacks a tensor.
    """
    with safetensors.safe_open(path, "pt") as file:
        text = (file.metadata() or {}).get(KEY)
    if text is None:
        return dict(own)
    try:
        said = json.loads(text)
        name, digest, shared = str(said["file"]), str(said["sha256"]), [str(each) for each in said["tensors"]]
    except (ValueError, KeyError, TypeError) as error:
        raise WeightsError(f"{path} says wrongly what it shares with another file: {error!r}") from None
    # Only a plain file name: a weights file must not make the reader open paths elsewhere.
    other = path.with_name(name) if Path(name).name == name else None
    if other is None or not other.is_file():
        raise WeightsError(f"{path} shares tensors with a file {name!r} beside it, which is not there")
    data = other.read_bytes()
    if (found := hashlib.sha256(data).hexdigest()) != digest:
        raise WeightsError(f"{path} goes with a {name!r} of SHA-256 {digest}; the one beside it has {found}")
    rest = safetensors.torch.load(data)
    if missing := [each for each in shared if each not in rest]:
        raise WeightsError(f"{path} takes {missing[0]!r} from {name!r}, which has no such tensor")
    return dict(sorted((dict(own) | {each: rest[each] for each in shared}).items()))


def save_difference(full: Path, other: Path, out: Path) -> int:
    """Write a file like ``full`` without the tensors that ``other`` has too, value by value; other facts are kept.

    Returns:
        How many tensors are shared.

    Raises:
        WeightsError: a file cannot be read, ``out`` would not lie beside ``other``, or nothing is shared.
    """
    if out.parent.resolve() != other.parent.resolve() or out.resolve() == other.resolve():
        raise WeightsError(f"{out} must lie beside {other}, with which it shares tensors")
    tensors, base = _read(full), _read(other)
    shared = sorted(
        name
        for name, tensor in tensors.items()
        if name in base and base[name].dtype == tensor.dtype and torch.equal(base[name], tensor)
    )
    if not shared:
        raise WeightsError(f"{full} shares no tensor with {other}")
    with safetensors.safe_open(full, "pt") as file:
        facts = dict(file.metadata() or {})
    digest = hashlib.sha256(other.read_bytes()).hexdigest()
    facts[KEY] = json.dumps({"file": other.name, "sha256": digest, "tensors": shared}, sort_keys=True)
    own = {name: tensors[name] for name in sorted(tensors) if name not in shared}
    write_file(out, _sorted_metadata(safetensors.torch.save(own, facts), facts))
    return len(shared)


def _read(path: Path) -> dict[str, Tensor]:
    try:
        return safetensors.torch.load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise WeightsError(f"{path} cannot be read as safetensors: {error}") from None


def _sorted_metadata(data: bytes, facts: Mapping[str, str]) -> bytes:
    """The same file with sorted metadata: the library's own order changes from run to run."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"] = dict(sorted(facts.items()))
    ordered = {"__metadata__": header["__metadata__"]} | {key: header[key] for key in header if key != "__metadata__"}
    text = json.dumps(ordered, separators=(",", ":")).encode()
    # The format pads its header with spaces so that tensors begin at a multiple of 8 bytes.
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[8 + size :]
