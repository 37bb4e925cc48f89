"""Depth Anything 3 Base as the start of training: its weights under the names of our encoder and depth head."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from torch import Tensor

from nurec_sim.errors import WeightsError

_BACKBONE = "backbone.pretrained."
_SCRATCH = "head.scratch."
_DROPPED = re.compile(r"backbone\.pretrained\.(camera_token|mask_token)$|head\..*_aux\.|head\..*_aux$")
_OTHER_PARTS = re.compile(r"(?!backbone\.|head\.|cam_enc\.)")  # pose decoder, Gaussian head
_RESIDUAL = {"resConfUnit1": "res_block", "resConfUnit2": "main_block"}
_CONVOLUTION = {"conv1": "1", "conv2": "3"}


def depth_anything_3_state(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The part of DA3-Base that the network starts training from: ``encoder.*`` and ``decoder.depth_head.*``.

    What the network has no use for (its camera token, ray head, pose decoder and Gaussian head) is left out.

    Args:
        state: tensors of ``model.safetensors``, with or without ``model.`` before every name.

    Raises:
        WeightsError: a name of the backbone, camera encoder or depth head is not known, or none of them is there.
    """
    result: dict[str, Tensor] = {}
    unknown = []
    for full_name, tensor in state.items():
        name = full_name.removeprefix("model.")
        if _OTHER_PARTS.match(name) or _DROPPED.match(name):
            continue
        if name == _BACKBONE + "pos_embed":
            result |= _position_embeddings(tensor)
        elif name == _BACKBONE + "cls_token":
            result["encoder.vit.cls_tokens"] = tensor.squeeze(1)
        elif (ours := _our_name(name)) is not None:
            result[ours] = tensor
        else:
            unknown.append(full_name)
    if unknown:
        raise WeightsError(f"not Depth Anything 3 Base: {len(unknown)} unknown names, such as {', '.join(unknown[:5])}")
    if not result:
        raise WeightsError("not Depth Anything 3 Base: nothing named backbone, cam_enc or head")
    return result


def _our_name(name: str) -> str | None:
    """The name of a tensor that is taken as it is."""
    for theirs, ours in (
        (_BACKBONE + "patch_embed.", "encoder.patch_embed_img."),
        (_BACKBONE + "blocks.", "encoder.vit.blocks."),
        (_BACKBONE + "norm.", "encoder.vit.norm_layer."),
        ("cam_enc.", "encoder.embed_camera."),
        ("head.norm.", "decoder.depth_head.reassemble.norm_layer."),
        ("head.projects.", "decoder.depth_head.reassemble.proj_layers."),
        ("head.resize_layers.", "decoder.depth_head.reassemble.resize_layers."),
        (_SCRATCH + "output_conv1.", "decoder.depth_head.fusion_head.before_conv."),
        (_SCRATCH + "output_conv2.", "decoder.depth_head.fusion_head.after_conv."),
    ):
        if name.startswith(theirs):
            return ours + name.removeprefix(theirs)
    rest = name.removeprefix(_SCRATCH)
    if found := re.fullmatch(r"layer([1-4])_rn\.(.+)", rest):
        return f"decoder.depth_head.reassemble.output_layers.{int(found[1]) - 1}.{found[2]}"
    if found := re.fullmatch(r"refinenet([1-4])\.(.+)", rest):
        block = f"decoder.depth_head.fusion_head.refinement_blocks.{int(found[1]) - 1}"
        if unit := re.fullmatch(r"(resConfUnit[12])\.(conv[12])\.(.+)", found[2]):
            return f"{block}.{_RESIDUAL[unit[1]]}.{_CONVOLUTION[unit[2]]}.{unit[3]}"
        if found[2].startswith("out_conv."):
            return f"{block}.{found[2]}"
    return None


def _position_embeddings(tensor: Tensor) -> dict[str, Tensor]:
    """[1, 1 + n n, c]: the class token's position, then those of a square grid of patches."""
    edge = math.isqrt(max(tensor.shape[1] - 1, 0))
    if tensor.ndim != 3 or tensor.shape[0] != 1 or edge * edge + 1 != tensor.shape[1]:
        raise WeightsError(f"not Depth Anything 3 Base: pos_embed of shape {list(tensor.shape)}")
    return {
        "encoder.vit.cls_pos_embed": tensor[:, 0],
        "encoder.vit.img_pos_embed": tensor[0, 1:].reshape(edge, edge, -1),
    }
