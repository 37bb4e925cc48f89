"""The decoder of camera responses: one 3x4 affine colour transform per camera (paper section 3.3)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from nurec_sim.network.attention import CrossAttention


class IspDecoder(nn.Module):
    """A learned token attends to the deepest features of all frames of one camera (paper section 3.3)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.affine_token = nn.Parameter(torch.zeros(width))
        self.kv_norm = nn.LayerNorm(width)
        self.affine_linear = nn.Linear(width, 12)
        self.affine_attention = CrossAttention(width, heads, normed=False, own_keys=True)

    def forward(
        self, patches: Float[Tensor, "b v y x c"], camera_idxs: Int64[Tensor, "b v"]
    ) -> Float[Tensor, "b cameras 3 4"]:
        """Affine transforms: identity plus what is decoded.

        Raises:
            ValueError: images are not camera-major with the same number for every camera.
        """
        cameras = cameras_of(camera_idxs)
        # All frames of a camera side by side: the response is that of the camera.
        tokens = self.kv_norm(patches).reshape(len(patches) * cameras, -1, patches.shape[-1])
        query = self.affine_token.expand(len(tokens), 1, -1)
        k, v = self.affine_attention.kv_projector(tokens)
        rows = self.affine_linear(self.affine_attention(query, k, v)).float().reshape(len(patches), cameras, 12)
        # Residual to the identity: with zero weights the response is neutral, so that training starts there (paper
        # section 3.3).
        matrix = rows[..., :9].unflatten(-1, (3, 3)) + torch.eye(3, device=rows.device)
        return torch.cat([matrix, rows[..., 9:, None]], dim=-1)


def cameras_of(camera_idxs: Int64[Tensor, "b v"]) -> int:
    """Number of cameras.

    Raises:
        ValueError: images are not camera-major with the same number for every camera.
    """
    images = camera_idxs.shape[1]
    cameras = int(camera_idxs.max()) + 1
    # The reshape in the decoder relies on this order; a wrong one would silently mix cameras.
    expected = torch.arange(cameras, device=camera_idxs.device).repeat_interleave(max(images // cameras, 1))
    if images % cameras or not bool((camera_idxs == expected[None]).all()):
        raise ValueError(
            "images must be sorted by camera, the same number for every camera, cameras counted from 0; "
            f"got camera_idxs {camera_idxs.tolist()}"
        )
    return cameras
