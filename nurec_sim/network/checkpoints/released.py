"""Weights that others publish: where they are, how long, and by what digest they are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from nurec_sim.network.profiles import PROFILES

_INSTANT_NUREC = "nvidia/instant-nurec"
_MULTIVIEW_SHA256 = "946e2f66aca98ce8bcdbb2d84f4292ffc2c0a59958c6a8410d24cce3d4b3933a"
_BASE_SHA256 = "e01067dc1659613083d9145a9a2547ccdbe6ccbbf83c4fe7b3e8a4e2bdae78b5"


@dataclass(frozen=True)
class ReleasedFile:
    """One published file on Hugging Face.

    A file is known by its size and, where one is published, its digest. Commit ids of the repositories are unknown,
    so the revision is a branch: its content must have the size and digest given here, or it is refused.

    Attributes:
        name: the profile that it is for; ``da3-base`` for the file that training starts from.
        repository: owner and name.
        filename: path in the repository.
        size_bytes: exact size.
        size_is_published: whether the size comes from the publisher; otherwise it is what ``torch.save`` makes of the
            known names and shapes in float32 under this file name, which gives the one published size to the byte.
        sha256: digest as hexadecimal text, None where none is published.
        license: the licence that governs its use.
        revision: branch, tag or commit to take it from unless another is requested.
    """

    name: str
    repository: str
    filename: str
    size_bytes: int
    size_is_published: bool
    sha256: str | None
    license: str
    revision: str = "main"


def _of_profile(name: str, size_bytes: int, *, size_is_published: bool, sha256: str | None = None) -> ReleasedFile:
    return ReleasedFile(
        name,
        _INSTANT_NUREC,
        f"pth/{PROFILES[name].checkpoint}.pth",
        size_bytes,
        size_is_published,
        sha256,
        "NVIDIA Open Model License",
    )


RELEASED: Mapping[str, ReleasedFile] = {
    file.name: file
    for file in (
        _of_profile("pa-front", 730_200_087, size_is_published=False),
        _of_profile("pa-multiview", 730_202_407, size_is_published=True, sha256=_MULTIVIEW_SHA256),
        _of_profile("pq-front", 1_141_125_047, size_is_published=False),
        # Training began from its revision f4a6c9b3...; only that beginning is published, so the digest identifies it.
        ReleasedFile(
            "da3-base",
            "depth-anything/DA3-BASE",
            "model.safetensors",
            541_518_028,
            True,
            _BASE_SHA256,
            "see the repository",
        ),
    )
}
"""By name."""
