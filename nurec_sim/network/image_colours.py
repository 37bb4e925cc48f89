"""Canonical colours taken from the images, for our own profiles: what the first camera shows, or would show.

The released network decodes a colour for every pixel. A small network loses detail that the image holds anyway; so
colours are only mapped from camera to camera, by the decoded responses. Every camera's own images are reproduced
exactly, and with a single camera its response does not matter.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.tensors import NetworkInputs


def image_colours(
    inputs: NetworkInputs, sky: Float[Tensor, "b 6 s s 3"], isp: Float[Tensor, "b cameras 3 4"]
) -> tuple[Float[Tensor, "b v h w 3"], Float[Tensor, "b 6 s s 3"], Float[Tensor, "b cameras 3 4"]]:
    """Colours of all pixels, of the sky, and responses, all with the first camera's colours as the canonical ones.

    Args:
        inputs: the images.
        sky: colours in the network's own canonical colours.
        isp: responses of the cameras to those.
    """
    first = isp[:, :1].expand_as(isp)
    # colour = inverse(isp_k)(image_k) is canonical to the network; the first camera's response on top makes that
    # camera's own map the identity.
    to_first = _after(first, _inverse(isp))
    of_image = to_first.gather(1, inputs.camera_idxs[..., None, None].expand(-1, -1, 3, 4))
    rgb = shown(inputs.rgb, of_image[:, :, None, None]).clamp(0, 1)
    return rgb, shown(sky, isp[:, 0, None, None, None]).clamp(0, 1), _after(isp, _inverse(first))


def shown(colour: Float[Tensor, "*n 3"], response: Float[Tensor, "*n 3 4"]) -> Float[Tensor, "*n 3"]:
    """Colours as a camera shows them. Not a matrix product: those may round differently with other thread counts."""
    return (colour[..., None, :] * response[..., :3]).sum(-1) + response[..., 3]


def _inverse(response: Float[Tensor, "*n 3 4"]) -> Float[Tensor, "*n 3 4"]:
    """Takes a response back; not finite where it cannot be, so that broken weights give no colours and no exception."""
    matrix = torch.linalg.inv_ex(response[..., :3].double()).inverse.to(response.dtype)
    return torch.cat([matrix, -(matrix * response[..., None, :, 3]).sum(-1, keepdim=True)], dim=-1)


def _after(second: Float[Tensor, "*n 3 4"], first: Float[Tensor, "*n 3 4"]) -> Float[Tensor, "*n 3 4"]:
    """One response after another."""
    matrix = (second[..., :3, None] * first[..., None, :, :3]).sum(-2)
    return torch.cat([matrix, shown(first[..., 3], second)[..., None]], dim=-1)
