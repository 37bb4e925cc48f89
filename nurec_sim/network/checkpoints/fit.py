"""Checks of a weights file: which profile it fits, and what is wrong with it."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from nurec_sim.errors import WeightsError
from nurec_sim.network.checkpoints.depth_anything import depth_anything_3_state
from nurec_sim.network.checkpoints.download import sha256, verify_file
from nurec_sim.network.checkpoints.released import RELEASED
from nurec_sim.network.checkpoints.state_dicts import (
    KeyDifferences,
    compare_keys,
    load_state_dict,
    non_finite,
    read_metadata,
)
from nurec_sim.network.lidar.branch import LidarBranch
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.network.model import InstantNuRec
from nurec_sim.network.profiles import PROFILES

_BASE = "da3-base"


@dataclass(frozen=True)
class WeightsReport:
    """Facts about a weights file, and its faults, a text each."""

    facts: list[tuple[str, str]]
    faults: list[str]


@functools.cache
def needed_state(profile: str) -> dict[str, Tensor]:
    """Names, shapes and types that a profile needs; the tensors hold no values and take no memory."""
    return _empty(profile).state_dict()


def count_parameters(profile: str) -> int:
    """How many numbers training chooses."""
    return sum(parameter.numel() for parameter in _empty(profile).parameters())


def _empty(profile: str) -> nn.Module:
    """The network of a profile without storage."""
    with torch.device("meta"):
        if profile in LIDAR_PROFILES:
            return LidarBranch(LIDAR_PROFILES[profile])
        return InstantNuRec(PROFILES[profile])


def check_weights(path: Path, profile: str | None = None) -> WeightsReport:
    """Read a weights file and compare it with the profiles and the released files.

    Args:
        path: the file.
        profile: what it should fit; whichever it does if not given.

    Raises:
        WeightsError: the file cannot be read, or there is no such profile.
    """
    known = [*PROFILES, *LIDAR_PROFILES]
    if profile is not None and profile not in known:
        raise WeightsError(f"no network profile {profile!r}; have {known}")
    path = Path(path)
    state = load_state_dict(path)
    faults = [f"{ascii(name)[1:-1]} holds values that are not finite" for name in non_finite(state)]
    differences = _differences(state)
    fits = [name for name, different in differences.items() if not different]
    if profile is not None and profile not in fits:
        faults.append(f"does not fit '{profile}': {differences[profile].describe()}")
    elif not fits:
        nearest = min(differences, key=lambda name: len(differences[name]))
        if len(differences[nearest].unexpected) == len(state):
            faults.append(f"is not of this network: none of its {len(state)} names is, such as {next(iter(state))!a}")
        else:
            faults.append(f"fits no profile; nearest is '{nearest}': {differences[nearest].describe()}")
    origin, origin_faults = _origin(path)
    types = Counter(str(tensor.dtype).removeprefix("torch.") for tensor in state.values())
    facts = [
        ("fits", ", ".join(fits) or "none"),
        ("tensors", str(len(state))),
        ("values", f"{sum(tensor.numel() for tensor in state.values()):,}"),
        ("types", ", ".join(f"{kind} x {count}" for kind, count in sorted(types.items()))),
        ("bytes", f"{path.stat().st_size:,}"),
        ("sha256", sha256(path)),
        ("released", origin),
        *((_printable(name), _printable(value)) for name, value in read_metadata(path).items()),
    ]
    return WeightsReport(facts, faults + origin_faults)


def _printable(text: str) -> str:
    """Text without what could steer a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _differences(state: Mapping[str, Tensor]) -> dict[str, KeyDifferences]:
    """How a state dict differs from what each profile needs, and DA3-Base from what training starts with."""
    found = {name: compare_keys(needed_state(name), state) for name in (*PROFILES, *LIDAR_PROFILES)}
    try:
        base = depth_anything_3_state(state)
    except WeightsError:
        return found
    needed = needed_state("pa-front")
    start = {name: needed[name] for name in needed if name.startswith(("encoder.", "decoder.depth_head."))}
    return found | {_BASE: compare_keys(start, base)}


def _origin(path: Path) -> tuple[str, list[str]]:
    """Which released file a file is, by size and digest; a fault if it only has the name of one."""
    for released in RELEASED.values():
        if path.stat().st_size != released.size_bytes:
            continue
        try:
            verify_file(path, released)
        except WeightsError as error:
            return f"no, but as long as that of '{released.name}'", [str(error)]
        how = "size and SHA-256" if released.sha256 else "size; no SHA-256 of it is published"
        return f"the file of '{released.name}', by {how}", []
    for released in RELEASED.values():
        name = released.filename.rsplit("/")[-1]
        if path.name == name and released.name != _BASE:
            return "no", [
                f"is named like the released file of '{released.name}', which has {released.size_bytes:,} bytes"
            ]
    return "no", []
