"""Weights from and to files: state dicts of the released network, of training runs, and our own.

Files are told apart by their first bytes, not by their names. Nothing in a file is ever run.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from nurec_sim.errors import WeightsError
from nurec_sim.files.new_files import write_file
from nurec_sim.network.checkpoints.shared import with_shared
from nurec_sim.network.checkpoints.torch_archive import read_torch_archive

_LEGACY_PROJECTOR = re.compile(r"^(post_processing\.affine_attention)\.(to_k|to_v)\.")
_METADATA_KEY = "nurec_sim"
_SHOWN = 20


@dataclass(frozen=True)
class KeyDifferences:
    """How a state dict differs from the one that a network needs; empty lists where it does not."""

    missing: list[str]
    unexpected: list[str]
    reshaped: list[str]

    def __bool__(self) -> bool:
        return bool(self.missing or self.unexpected or self.reshaped)

    def __len__(self) -> int:
        return len(self.missing) + len(self.unexpected) + len(self.reshaped)

    def describe(self) -> str:
        """All of it as one text; long lists are cut after 20 names."""
        kinds = (("missing", self.missing), ("unexpected", self.unexpected), ("of another shape", self.reshaped))
        return "; ".join(f"{len(names)} {kind}: {_listed(names)}" for kind, names in kinds if names)


def load_state_dict(path: Path) -> dict[str, Tensor]:
    """Named tensors of a weights file, on the CPU, in the types and under the names of the released network.

    Reads plain dicts of ``torch.save``, training files with ``state_dict`` (``model.`` prefix or not), and safetensors.
    A ``model.`` before every name is dropped, the older names of the ISP projector are renewed.

    Raises:
        WeightsError: there is no such file, it is none of these, or it is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise WeightsError(f"no weights at {str(path)!r}; give a .pth, .ckpt or .safetensors file")
    try:
        with path.open("rb") as file:
            head = file.read(9)
    except OSError as error:
        raise WeightsError(f"{path} cannot be read: {error.strerror}") from None
    # torch.save writes a zip archive; safetensors begin with 8 bytes of header length and a JSON object.
    if head.startswith(b"PK\x03\x04"):
        state = read_torch_archive(path)
    elif head[8:] == b"{":
        state = _read_safetensors(path)
    elif head.startswith(b"\x80"):
        raise WeightsError(
            f"{path} is a bare pickle, as torch.save wrote before version 1.6; reading it would run what it says: "
            "load it where you trust it and save it again"
        )
    else:
        raise WeightsError(f"{path} is neither a file of torch.save nor safetensors")
    # Lightning prefixes the module's attribute name; the released files have none.
    if all(name.startswith("model.") for name in state):
        state = {name.removeprefix("model."): tensor for name, tensor in state.items()}
    renewed = {_LEGACY_PROJECTOR.sub(r"\1.kv_projector.\2.", name): tensor for name, tensor in state.items()}
    if len(renewed) != len(state):
        raise WeightsError(f"{path} holds the ISP projector twice, under its older and its newer name")
    return renewed


def compare_keys(needed: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> KeyDifferences:
    """Names that only one of two state dicts has, and those whose shapes differ."""
    return KeyDifferences(
        missing=[name for name in needed if name not in given],
        unexpected=[name for name in given if name not in needed],
        reshaped=[
            f"{name} {list(given[name].shape)} instead of {list(tensor.shape)}"
            for name, tensor in needed.items()
            if name in given and given[name].shape != tensor.shape
        ],
    )


def non_finite(state: Mapping[str, Tensor]) -> list[str]:
    """Names of the tensors that hold infinities or no numbers."""
    return [name for name, tensor in state.items() if not torch.isfinite(tensor).all()]


def load_weights(module: nn.Module, path: Path, profile_name: str) -> None:
    """Fill a network from a file. Every parameter and buffer must be there, and nothing else.

    Half and double precision are converted to the module's own types. On an error the module is left as it was.

    Args:
        module: the network.
        path: the file.
        profile_name: what to call the network in errors.

    Raises:
        WeightsError: the file cannot be read, its names or shapes are another network's (the text lists them), or its
            values are not finite.
    """
    state = load_state_dict(path)
    needed = module.state_dict()
    if differences := compare_keys(needed, state):
        raise WeightsError(f"{path} does not fit profile '{profile_name}': {differences.describe()}")
    if wrong := [
        name for name, tensor in needed.items() if state[name].dtype.is_floating_point != tensor.is_floating_point()
    ]:
        raise WeightsError(f"{path}: {len(wrong)} of another kind of number: {_listed(wrong)}")
    state = {name: state[name].to(tensor.dtype) for name, tensor in needed.items()}
    _refuse_non_finite(path, state)
    module.load_state_dict(state, strict=True)


def save_weights(module: nn.Module, path: Path, metadata: Mapping[str, str], *, half: bool = False) -> None:
    """Write a network's weights as safetensors; the same weights give the same bytes.

    Args:
        module: the network.
        path: the file; it appears complete or not at all, and replaces one that is there.
        metadata: facts about the weights, such as how they came about; ``read_metadata`` returns them.
        half: round parameters to half precision; buffers are constants and stay exact.

    Raises:
        WeightsError: values are not finite, or too large for half precision.
    """
    parameters = {name for name, _ in module.named_parameters()}
    tensors = {
        name: (tensor.half() if half and name in parameters and tensor.is_floating_point() else tensor)
        .cpu()
        .contiguous()
        for name, tensor in module.state_dict().items()
    }
    _refuse_non_finite(path, tensors)
    # One entry only: the library writes several in an order that changes from run to run.
    data = safetensors.torch.save(tensors, {_METADATA_KEY: json.dumps(dict(metadata), sort_keys=True)})
    write_file(path, data)


def read_metadata(path: Path) -> dict[str, str]:
    """The facts that ``save_weights`` stored in a file; empty for other files."""
    with path.open("rb") as file:
        if file.read(9)[8:] != b"{":
            return {}
    try:
        with safetensors.safe_open(path, "pt") as file:
            found = json.loads((file.metadata() or {}).get(_METADATA_KEY, "{}"))
    except (safetensors.SafetensorError, ValueError) as error:
        raise WeightsError(f"{path} is damaged: {error}") from None
    return {str(name): str(value) for name, value in found.items()} if isinstance(found, dict) else {}


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    """The tensors in the order of their names, for the library's own order changes from run to run."""
    try:
        own = dict(sorted(safetensors.torch.load_file(path).items()))
        return with_shared(path, own)
    except (safetensors.SafetensorError, KeyError) as error:  # KeyError: a type that torch lacks
        raise WeightsError(f"{path} is damaged: {error}") from None


def _refuse_non_finite(path: Path, state: Mapping[str, Tensor]) -> None:
    if wrong := non_finite(state):
        raise WeightsError(f"{path}: {len(wrong)} tensors hold values that are not finite: {_listed(wrong)}")


def _listed(names: Sequence[str]) -> str:
    """Names for a message: all, or the first and how many more; without control characters."""
    shown = ", ".join(ascii(name)[1:-1][:160] for name in names[:_SHOWN])
    return f"{shown} and {len(names) - _SHOWN} more" if len(names) > _SHOWN else shown
