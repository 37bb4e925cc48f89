"""The Instant NuRec network (docs/network.md): profiles, the module, its inputs and outputs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nurec_sim.network.profiles import PROFILES, Profile

if TYPE_CHECKING:
    from nurec_sim.network.model import InstantNuRec, Precision

__all__ = ["PROFILES", "Profile", "build"]


def build(profile: str | Profile, *, seed: int | None = 0, precision: Precision = "float32") -> InstantNuRec:
    """The network of a profile, ready for inference.

    Args:
        profile: a name in ``PROFILES``, or custom sizes.
        seed: of the random parameters. None leaves parameters uninitialised, which is faster if
            ``checkpoints.load_weights`` fills them anyway.
        precision: of matrix products and convolutions.

    Raises:
        ValueError: no such profile.
    """
    import torch

    from nurec_sim.network.model import InstantNuRec, initialize

    if isinstance(profile, str):
        if profile not in PROFILES:
            raise ValueError(f"no network profile {profile!r}; have {list(PROFILES)}")
        profile = PROFILES[profile]
    if seed is None:
        # Built without storage, then allocated: random initialisation takes longer than reading a file. Constant
        # buffers are lost on the way and set again.
        with torch.device("meta"):
            model = InstantNuRec(profile)
        model = model.to_empty(device="cpu")
        if model.sky is not None:
            model.sky.set_constants()
    else:
        model = InstantNuRec(profile)
        initialize(model, seed)
    model.precision = precision
    return model.eval()
