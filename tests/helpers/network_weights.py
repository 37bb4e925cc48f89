"""Small stand-ins for weights: a module, and the names of DA3-Base."""

import json
from pathlib import Path

import torch
from torch import Tensor, nn

KEYS = Path(__file__).parents[1] / "data" / "network_keys"


class Part(nn.Module):
    """A little of everything: parameters, a buffer, an empty tensor."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(5, 7)
        self.norm = nn.LayerNorm(7)
        self.cls_tokens = nn.Parameter(torch.zeros(0, 7))
        self.register_buffer("cuboids_dims_padding", torch.ones(3))


def part(seed: int = 0) -> Part:
    torch.manual_seed(seed)
    module = Part()
    nn.init.normal_(module.norm.weight)
    return module


def base_names() -> dict[str, list[int]]:
    """Names and shapes of DA3-Base as far as the network takes them over, from those of the network."""
    needed = json.loads((KEYS / "pa_front.json").read_text())
    rules = [
        ("encoder.patch_embed_img.", "backbone.pretrained.patch_embed."),
        ("encoder.vit.blocks.", "backbone.pretrained.blocks."),
        ("encoder.vit.norm_layer.", "backbone.pretrained.norm."),
        ("encoder.embed_camera.", "cam_enc."),
        ("decoder.depth_head.reassemble.norm_layer.", "head.norm."),
        ("decoder.depth_head.reassemble.proj_layers.", "head.projects."),
        ("decoder.depth_head.reassemble.resize_layers.", "head.resize_layers."),
        ("decoder.depth_head.fusion_head.before_conv.", "head.scratch.output_conv1."),
        ("decoder.depth_head.fusion_head.after_conv.", "head.scratch.output_conv2."),
    ]
    rules += [(f"decoder.depth_head.reassemble.output_layers.{i}.", f"head.scratch.layer{i + 1}_rn.") for i in range(4)]
    for i in range(4):
        ours, theirs = f"decoder.depth_head.fusion_head.refinement_blocks.{i}.", f"head.scratch.refinenet{i + 1}."
        rules += [
            (f"{ours}res_block.1.", f"{theirs}resConfUnit1.conv1."),
            (f"{ours}res_block.3.", f"{theirs}resConfUnit1.conv2."),
            (f"{ours}main_block.1.", f"{theirs}resConfUnit2.conv1."),
            (f"{ours}main_block.3.", f"{theirs}resConfUnit2.conv2."),
            (f"{ours}out_conv.", f"{theirs}out_conv."),
        ]
    names = {}
    for name, fact in needed.items():
        for ours, theirs in rules:
            if name.startswith(ours):
                names[f"model.{theirs}{name.removeprefix(ours)}"] = fact["shape"]
    names["model.backbone.pretrained.cls_token"] = [1, 1, 768]
    names["model.backbone.pretrained.pos_embed"] = [1, 1 + 37 * 37, 768]
    return names


DROPPED = {
    "model.backbone.pretrained.camera_token": [1, 2, 768],
    "model.head.scratch.refinenet1_aux.out_conv.weight": [2],
    "model.head.scratch.output_conv1_aux.0.0.weight": [2],
    "model.head.scratch.output_conv2_aux.3.5.bias": [2],
    "model.cam_dec.fc_t.weight": [2],
    "model.gs_head.scratch.output_conv1.weight": [2],
}


def base_state() -> dict[str, Tensor]:
    """Every tensor filled with its own number; big ones take no memory."""
    return {
        name: torch.full((), float(i)).expand(shape) for i, (name, shape) in enumerate((base_names() | DROPPED).items())
    }
