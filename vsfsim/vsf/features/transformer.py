"""DINOv2's vision transformer, forward pass only (Oquab et al. 2023; code of facebookresearch/dinov2).

Patches of 14 x 14 pixels become tokens by a linear map. A class token is put before them and learned positions are
added. The blocks are pre-norm: x + ls1 * attention(norm1(x)), then x + ls2 * mlp(norm2(x)) with a GELU and layer scale
ls. A last norm follows. The state dict has the names and shapes of the published checkpoints and of timm's
`vit_small_patch14_dinov2` and `vit_base_patch14_dinov2`.

timm itself is no dependency. It cannot be imported without torchvision, whose wheels on PyPI are built for CUDA: beside
a CPU build of torch their import fails ("operator torchvision::nms does not exist"; timm 1.0.31, torchvision 0.28.0,
torch 2.13.0+cpu). `references/dinov2` has the comparison of this transformer with timm's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional


@dataclass(frozen=True)
class Architecture:
    """Sizes of a vision transformer."""

    width: int
    """Numbers of a token, D."""
    depth: int
    """Blocks."""
    heads: int
    """Heads of the attention."""
    patch: int = 14
    """Edge of a patch [px]."""
    grid: int = 37
    """Patches along an edge of the images whose positions were learned (518 px / 14)."""


SMALL, BASE = Architecture(384, 12, 6), Architecture(768, 12, 12)

# Added to the count of patches before the positions are interpolated, as in the published code (interpolate_offset).
_OFFSET = 0.1


class VisionTransformer(nn.Module):
    """The module's transformer, for normalised images (b, 3, h, w), h and w multiples of the patch."""

    def __init__(self, architecture: Architecture):
        super().__init__()
        a = self.architecture = architecture
        self.cls_token = nn.Parameter(torch.zeros(1, 1, a.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + a.grid**2, a.width))
        self.patch_embed = _PatchEmbed(a)
        self.blocks = nn.ModuleList([_Block(a) for _ in range(a.depth)])
        self.norm = nn.LayerNorm(a.width, eps=1e-6)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)
        nn.init.normal_(self.cls_token, std=1e-6)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Class token (b, D) and patch tokens (b, h / patch, w / patch, D), both after the last norm."""
        patch = self.architecture.patch
        rows, columns = images.shape[2] // patch, images.shape[3] // patch
        x = self.patch_embed(images)
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], dim=1) + self.positions(rows, columns)
        for block in self.blocks:
            x = block(x)
        x = self.norm(x)
        return x[:, 0], x[:, 1:].reshape(len(x), rows, columns, -1)

    def positions(self, rows: int, columns: int) -> torch.Tensor:
        """Position of every token of a grid (1, 1 + rows * columns, D), interpolated from the learned ones."""
        grid = self.architecture.grid
        if rows == columns == grid:
            return self.pos_embed
        learned = self.pos_embed[:, 1:].reshape(1, grid, grid, -1).permute(0, 3, 1, 2)
        scale = ((rows + _OFFSET) / grid, (columns + _OFFSET) / grid)
        stretched = functional.interpolate(learned, scale_factor=scale, mode="bicubic")
        assert stretched.shape[2:] == (rows, columns)
        return torch.cat([self.pos_embed[:, :1], stretched.permute(0, 2, 3, 1).flatten(1, 2)], dim=1)


class _PatchEmbed(nn.Module):
    def __init__(self, a: Architecture):
        super().__init__()
        self.proj = nn.Conv2d(3, a.width, a.patch, stride=a.patch)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.proj(images).flatten(2).transpose(1, 2)


class _Block(nn.Module):
    def __init__(self, a: Architecture):
        super().__init__()
        self.norm1, self.attn, self.ls1 = nn.LayerNorm(a.width, eps=1e-6), _Attention(a), _LayerScale(a.width)
        self.norm2, self.mlp, self.ls2 = nn.LayerNorm(a.width, eps=1e-6), _Mlp(a.width), _LayerScale(a.width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class _Attention(nn.Module):
    def __init__(self, a: Architecture):
        super().__init__()
        self.heads = a.heads
        self.qkv, self.proj = nn.Linear(a.width, 3 * a.width), nn.Linear(a.width, a.width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        count, tokens, width = x.shape
        parts = self.qkv(x).reshape(count, tokens, 3, self.heads, width // self.heads)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        weight = (query @ key.transpose(-2, -1) / math.sqrt(width // self.heads)).softmax(dim=-1)
        return self.proj((weight @ value).transpose(1, 2).reshape(count, tokens, width))


class _Mlp(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.fc2(functional.gelu(self.fc1(x)))


class _LayerScale(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), 1.0))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x * self.gamma
