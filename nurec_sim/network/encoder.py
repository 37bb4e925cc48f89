"""The shared encoder: images and cameras in, four levels of features out (paper section 3.2, spec DA3-Base).

A DINOv2-like vision transformer whose later blocks alternate between attention within an image and across all images.
Each image carries one extra token: first the class token, then one that encodes the image's camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.attention import Mlp, Rope, SelfBlock
from nurec_sim.network.car_view import CHANNELS
from nurec_sim.network.profiles import PATCH_PX, EncoderSize

# Of ImageNet, with which DINOv2 was trained.
IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
RAY_OCTAVES = 6


def normalized(rgb: Float[Tensor, "*n h w 3"]) -> Float[Tensor, "*n h w 3"]:
    """Colours with ImageNet's mean and deviation taken out."""
    return (rgb - rgb.new_tensor(IMAGE_MEAN)) / rgb.new_tensor(IMAGE_STD)


@dataclass(frozen=True)
class Features:
    """One level of encoder features of every image: patches and the image's own token, each [.., 2c].

    The first half of the channels is the state after the last block within images, the second half the state after the
    block across images: normed in ``patches``, unnormed in ``token``.
    """

    patches: Float[Tensor, "b v y x d"]
    token: Float[Tensor, "b v d"]

    @property
    def merged(self) -> Features:
        """The second half of the channels: the state after attention across images."""
        half = self.patches.shape[-1] // 2
        return Features(self.patches[..., half:], self.token[..., half:])


class PatchEmbedding(nn.Module):
    """Square patches as tokens."""

    def __init__(self, width: int, channels: int = 3, normed: bool = False) -> None:
        super().__init__()
        self.proj = nn.Conv2d(channels, width, PATCH_PX, PATCH_PX)
        self.norm = nn.LayerNorm(width) if normed else nn.Identity()

    def forward(self, images: Float[Tensor, "n h w c"]) -> Float[Tensor, "n y x d"]:
        """Tokens by row and column."""
        return self.norm(self.proj(images.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))


class CameraEmbedding(nn.Module):
    """A token per image from its pose and field of view; the tokens of all images attend to each other."""

    def __init__(self, size: EncoderSize) -> None:
        super().__init__()
        self.pose_branch = Mlp(9, size.width // 2, size.width)
        self.token_norm = nn.LayerNorm(size.width)
        self.trunk = nn.ModuleList(
            SelfBlock(size.width, size.camera_heads, normed=False, eps=1e-5, scale=0.01)
            for _ in range(size.camera_depth)
        )
        self.trunk_norm = nn.LayerNorm(size.width)

    def forward(self, c2w: Float[Tensor, "b v 4 4"], fov: Float[Tensor, "b v 2"]) -> Float[Tensor, "b v c"]:
        """Camera tokens; always in float32."""
        # Half precision would round translations of tens of metres to centimetres; the release runs this in float32
        # too.
        with torch.autocast(c2w.device.type, enabled=False):
            # Position (3), rotation (4), vertical and horizontal field of view (2): the order of the checkpoints.
            code = torch.cat([c2w[..., :3, 3], quaternion_xyzw(c2w[..., :3, :3]), fov.flip(-1)], dim=-1)
            x = self.token_norm(self.pose_branch(code.float()))
            for block in self.trunk:
                x = block(x)
            return self.trunk_norm(x)


class ViewPatches(nn.Module):
    """``car_view`` embedded per patch and added to the image tokens: patch means, with sinusoids of the direction.

    Not part of the released network.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = Mlp(CHANNELS + 3 * 2 * RAY_OCTAVES, width, width)

    def forward(self, view: Float[Tensor, "n h w 12"]) -> Float[Tensor, "n y x d"]:
        """Tokens by row and column; always in float32."""
        with torch.autocast(view.device.type, enabled=False):
            mean = functional.avg_pool2d(view.float().permute(0, 3, 1, 2), PATCH_PX).permute(0, 2, 3, 1)
            # NeRF-like octaves (Mildenhall et al. 2020): an MLP alone resolves only low frequencies of the direction.
            angle = mean[..., 3:6, None] * (math.pi * 2.0 ** torch.arange(RAY_OCTAVES, device=view.device))
            waves = torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2)
            return self.mlp(torch.cat([mean, waves], dim=-1))


class AlternatingTransformer(nn.Module):
    """The vision transformer: first attention within images, then alternately within images and across the clip."""

    def __init__(self, size: EncoderSize) -> None:
        super().__init__()
        self.size = size
        self.cls_tokens = nn.Parameter(torch.zeros(1, size.width))
        self.cls_pos_embed = nn.Parameter(torch.zeros(1, size.width))
        self.img_pos_embed = nn.Parameter(torch.zeros(size.position_grid, size.position_grid, size.width))
        # Only the second half of each tap goes through this norm; the local half stays raw (spec section 1.2).
        self.norm_layer = nn.LayerNorm(size.width)
        self.blocks = nn.ModuleList(
            SelfBlock(size.width, size.heads, normed=number >= size.alternate_from, eps=1e-6, scale=1.0)
            for number in range(size.depth)
        )

    def forward(
        self, patches: Float[Tensor, "b v y x c"], camera_token: Float[Tensor, "b v c"]
    ) -> tuple[Features, ...]:
        """Features after each tap."""
        b, v, rows, columns, width = patches.shape
        patches = patches + resampled_positions(self.img_pos_embed, rows, columns)
        class_token = (self.cls_tokens + self.cls_pos_embed).expand(b * v, 1, width)
        x = torch.cat([class_token.to(patches.dtype), patches.reshape(b * v, rows * columns, width)], dim=1)
        head_width = width // self.size.heads
        # Within an image, attention depends on how far apart patches are; across images that distance has no meaning.
        local = Rope(local_positions(rows, columns, 1, x.device), head_width)
        everywhere = Rope(global_positions(rows * columns, v, x.device), head_width)
        taps, local_x = [], x
        for number, block in enumerate(self.blocks):
            if number == self.size.alternate_from:
                # From here on images are compared, so each one's token must encode where it was taken. It
                # replaces the class token, as in Depth-Anything-3.
                x = torch.cat([camera_token.reshape(b * v, 1, width).to(x.dtype), x[:, 1:]], dim=1)
            if number < self.size.alternate_from:
                x = block(x)
            elif number % 2 == 0:
                x = local_x = block(x, local)
            else:
                # All tokens of a clip attend to each other: [b, v * n, c].
                x = block(x.reshape(b, -1, width), everywhere).reshape(b * v, -1, width)
            if number in self.size.taps:
                # Heads see both: local_x is sharp within the image, x is consistent across images.
                state = torch.cat([local_x[:, 1:], self.norm_layer(x[:, 1:]).to(x.dtype)], dim=-1)
                token = torch.cat([local_x[:, 0], x[:, 0]], dim=-1)
                taps.append(Features(state.reshape(b, v, rows, columns, -1), token.reshape(b, v, -1)))
        return tuple(taps)


class Encoder(nn.Module):
    """Images and cameras to features."""

    def __init__(self, size: EncoderSize) -> None:
        super().__init__()
        self.patch_embed_img = PatchEmbedding(size.width)
        self.patch_embed_view = ViewPatches(size.width) if size.car_view else None
        self.embed_camera = CameraEmbedding(size)
        self.vit = AlternatingTransformer(size)

    def forward(
        self,
        rgb: Float[Tensor, "b v h w 3"],
        c2w: Float[Tensor, "b v 4 4"],
        fov: Float[Tensor, "b v 2"],
        view: Float[Tensor, "b v h w 12"] | None = None,
    ) -> tuple[Features, ...]:
        """Four levels of features, from early to deep.

        Args:
            rgb: colours 0..1; h and w multiples of 14.
            c2w: scene_from_camera, translation times ``SCENE_RESCALE``.
            fov: horizontal and vertical field of view, radians.
            view: the ``car_view`` of profiles that use one.
        """
        patches = self.patch_embed_img(normalized(rgb.flatten(0, 1)))
        if self.patch_embed_view is not None and view is not None:
            patches = patches + self.patch_embed_view(view.flatten(0, 1)).to(patches.dtype)
        return self.vit(patches.unflatten(0, rgb.shape[:2]), self.embed_camera(c2w, fov))


def local_positions(rows: int, columns: int, tokens: int, device: torch.device) -> Int64[Tensor, "n 2"]:
    """(y, x) of the tokens of one image: extra tokens run down the diagonal from the origin, then come the patches.

    Args:
        rows: of patches.
        columns: of patches.
        tokens: number of extra tokens; patch (y, x) lies at (y + tokens, x + tokens).
        device: of the result.
    """
    y, x = torch.meshgrid(torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij")
    patches = torch.stack([y, x], dim=-1).reshape(-1, 2) + tokens
    return torch.cat([torch.arange(tokens, device=device)[:, None].expand(tokens, 2), patches])


def global_positions(patches: int, images: int, device: torch.device) -> Int64[Tensor, "n 2"]:
    """(y, x) of the tokens of all images: patches all share (1, 1), only camera tokens differ with (0, 0)."""
    one_image = torch.ones(1 + patches, 2, dtype=torch.int64, device=device)
    one_image[0] = 0
    return one_image.repeat(images, 1)


def resampled_positions(grid: Float[Tensor, "g g c"], rows: int, columns: int) -> Float[Tensor, "rows columns c"]:
    """Learned positions at another number of patches.

    Bicubic, by the scale (rows + 0.1) / g rather than the size: the samples lie where the checkpoints were trained.
    """
    scale = tuple((count + 0.1) / grid.shape[0] for count in (rows, columns))
    resampled = functional.interpolate(grid.permute(2, 0, 1)[None].float(), scale_factor=scale, mode="bicubic")
    return resampled[0].permute(1, 2, 0)[:rows, :columns]


def quaternion_xyzw(rotation: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 4"]:
    """Unit quaternions (x, y, z, w) of rotation matrices, w >= 0, by the largest of the four components."""
    # Row k of the candidates is 4 q_k (x, y, z, w). The row of the largest component never divides by nearly zero
    # (Shepperd 1978), and choosing it keeps the gradient finite everywhere.
    m = rotation.flatten(-2)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m.unbind(-1)
    candidates = torch.stack(
        [
            torch.stack([1 + m00 - m11 - m22, m01 + m10, m02 + m20, m21 - m12], dim=-1),
            torch.stack([m01 + m10, 1 - m00 + m11 - m22, m12 + m21, m02 - m20], dim=-1),
            torch.stack([m02 + m20, m12 + m21, 1 - m00 - m11 + m22, m10 - m01], dim=-1),
            torch.stack([m21 - m12, m02 - m20, m10 - m01, 1 + m00 + m11 + m22], dim=-1),
        ],
        dim=-2,
    )
    # The diagonal holds 4 q_k^2.
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*rotation.shape[:-2], 1, 4)
    quaternion = functional.normalize(candidates.gather(-2, best)[..., 0, :], dim=-1)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
