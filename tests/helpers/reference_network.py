"""The two open cases of the reference network, and the rule that makes their weights from nothing but key names."""

import json
import math
import zlib
from pathlib import Path

import numpy as np
import torch

from nurec_sim import network
from nurec_sim.network.tensors import NetworkInputs

FOLDER = Path(__file__).parents[1] / "data"
PROFILES = {"pa_front": "pa-front", "pq_road": "pq-front"}
TOKENS = ("pos_embed", "cls_tokens", "cls_pos_embed", "affine_token", "sky.token")
CONTEXT_BIAS = "decoder.context_head.fusion_head.after_conv.2.bias"
RAISED_LOGITS = {"pa_front": {6: 2.2, 7: 2.8, 9: 2.2}, "pq_road": {9: 3.0}}


def key_list(name):
    """Shapes and types of a published state dict by key."""
    return json.loads((FOLDER / "network_keys" / f"{name}.json").read_text())


def made_weight(key, shape):
    """Values that depend on the key alone: uniform numbers of unit variance, scaled by what the key names."""
    if key.endswith("cuboids_dims_padding"):
        return np.ones(shape, np.float32)
    stream = np.random.RandomState(zlib.crc32(key.encode()))
    z = (2 * stream.random_sample(math.prod(shape)) - 1).reshape(shape) * math.sqrt(3)
    if any(name in key for name in TOKENS):
        values = 0.5 * z
    elif len(shape) >= 2:
        values = z / math.sqrt(math.prod(shape[1:]))
    elif key.endswith(".weight"):
        values = 1 + 0.1 * z
    elif key.endswith(".gamma"):
        values = 0.5 + 0.1 * z
    else:
        values = 0.1 * z
    return np.ascontiguousarray(values, np.float32)


def reference_model(case):
    """The network of a case with its weights."""
    model = network.build(PROFILES[case], seed=None)
    state = {key: torch.from_numpy(made_weight(key, tuple(entry["shape"]))) for key, entry in key_list(case).items()}
    for channel, raise_by in RAISED_LOGITS[case].items():
        state[CONTEXT_BIAS][channel] += raise_by
    model.load_state_dict(state, strict=True)
    return model


def reference_arrays(case):
    """All arrays of a case by name."""
    with np.load(FOLDER / "reference_network" / f"{case}.npz") as file:
        return {name: file[name] for name in file.files}


def reference_inputs(arrays):
    """The network's inputs of a case; motion times are those of the pixel in the middle."""
    height, width = arrays["in/rays_timestamps_us"].shape[1:3]
    centre_us = arrays["in/rays_timestamps_us"][:, height // 2, width // 2, 0]
    gap_us, (start_us, end_us) = arrays["in/frame_gap_timestamps_us"], arrays["in/time_span_us"]

    def fraction(t_us):
        return torch.tensor((t_us - start_us) / (end_us - start_us), dtype=torch.float32)[None]

    names = ("rgb", "c2w", "fov", "rays", "distance_to_depth_scale", "camera_idxs")
    given = {name: torch.from_numpy(arrays[f"in/{name}"]) for name in names}
    times = (fraction(centre_us), fraction(centre_us - gap_us[:, 0]), fraction(centre_us + gap_us[:, 1]))
    return NetworkInputs(**given, time=times[0], time_before=times[1], time_after=times[2])
