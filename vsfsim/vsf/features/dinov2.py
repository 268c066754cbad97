"""DINOv2 features of a view (SBML appendix B.2): patch tokens of a pretrained vision transformer, from weights on this
machine.

Nothing is downloaded here. The authors' `dinov2_vits14_pretrain.pth` is searched for where the user says, in the folder
$VSFSIM_DINOV2, and in torch.hub's cache. The error about missing weights prints the command that fetches it. It is read
as plain tensors (no code in it is run) and must fit the architecture name for name.

The transformer is DINOv2's, forward pass only (Oquab et al. 2023; code of facebookresearch/dinov2). Patches of 14 x 14
pixels become tokens by a linear map. A class token is put before them and learned positions are added. The blocks are
pre-norm: x + ls1 * attention(norm1(x)), then x + ls2 * mlp(norm2(x)) with a GELU and layer scale ls. A last norm
follows.

timm itself is no dependency. It cannot be imported without torchvision, whose wheels on PyPI are built for CUDA: beside
a CPU build of torch their import fails ("operator torchvision::nms does not exist"; timm 1.0.31, torchvision 0.28.0,
torch 2.13.0+cpu). `references/dinov2` has the comparison of this transformer with timm's.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from vsfsim.core.errors import VsfError
from vsfsim.core.plain_text import plain
from vsfsim.data.disk import file_sha256
from vsfsim.data.records import View
from vsfsim.vsf.features.interface import FeatureImage, Projection


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
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, a.width, a.patch, stride=a.patch)})
        self.blocks = nn.ModuleList([_Block(a) for _ in range(a.depth)])
        self.norm = nn.LayerNorm(a.width, eps=1e-6)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)
        nn.init.normal_(self.cls_token, std=1e-6)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Class token (b, D) and patch tokens (b, h / patch, w / patch, D), both after the last norm."""
        patch = self.architecture.patch
        rows, columns = images.shape[2] // patch, images.shape[3] // patch
        x = self.patch_embed["proj"](images).flatten(2).transpose(1, 2)
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


class _Block(nn.Module):
    """Attention and a perceptron, each after a norm, scaled and added."""

    def __init__(self, a: Architecture):
        super().__init__()
        self.heads, wide = a.heads, 4 * a.width
        self.norm1, self.norm2 = nn.LayerNorm(a.width, eps=1e-6), nn.LayerNorm(a.width, eps=1e-6)
        self.attn = nn.ModuleDict({"qkv": nn.Linear(a.width, 3 * a.width), "proj": nn.Linear(a.width, a.width)})
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(a.width, wide), "fc2": nn.Linear(wide, a.width)})
        self.ls1, self.ls2 = (nn.ParameterDict({"gamma": torch.ones(a.width)}) for _ in range(2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        parts = self.attn["qkv"](self.norm1(x)).unflatten(2, (3, self.heads, -1))
        mixed = functional.scaled_dot_product_attention(*parts.permute(2, 0, 3, 1, 4)).transpose(1, 2).flatten(2)
        x = x + self.ls1["gamma"] * self.attn["proj"](mixed)
        return x + self.ls2["gamma"] * self.mlp["fc2"](functional.gelu(self.mlp["fc1"](self.norm2(x))))


ARCHITECTURES: dict[str, Architecture] = {"small": SMALL, "base": BASE}
FILES = {"small": "dinov2_vits14_pretrain.pth", "base": "dinov2_vitb14_pretrain.pth"}
"""File names of the authors' weights."""
FOLDER_VARIABLE = "VSFSIM_DINOV2"

_ADDRESS = "https://dl.fbaipublicfiles.com/dinov2/{folder}/{file}"
# The mask token serves pre-training only.
_UNUSED = {"mask_token"}
# Colour statistics of the training images (ImageNet).
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Dinov2:
    """Patch features of one model; see `load`."""

    def __init__(self, model: VisionTransformer, *, device: str = "cpu"):
        self.model, self.device = model.to(device).eval(), device

    @classmethod
    def load(cls, size: str, weights: str = "", *, device: str = "cpu") -> Dinov2:
        """The model with published weights.

        Args:
            size: "small" or "base".
            weights: the file; "" searches as `find_weights` does.
            device: torch device.

        Raises:
            VsfError: no weights, or a file that is not of this architecture.
        """
        path = find_weights(size, weights)
        return cls(_loaded(size, str(path), file_sha256(path)), device=device)

    @torch.no_grad()
    def image(self, view: View) -> FeatureImage:
        """Patch tokens, one cell a patch of 14 x 14 pixels (h, w, D); a patch that meets the mask is valid."""
        patch = self.model.architecture.patch
        height, width = view.mask.shape
        # Bottom and right are padded to whole patches, so that cell (i, j) keeps its place in the image.
        down, right = -height % patch, -width % patch
        rgb = torch.tensor(np.array(view.rgb), dtype=torch.float32, device=self.device).permute(2, 0, 1) / 255.0
        mean, std = (torch.tensor(x, device=self.device)[:, None, None] for x in (_MEAN, _STD))
        token, tokens = self.model(functional.pad((rgb - mean) / std, (0, right, 0, down))[None])
        mask = np.pad(np.asarray(view.mask, bool), ((0, down), (0, right)))
        valid = np.any(mask.reshape(mask.shape[0] // patch, patch, -1, patch), axis=(1, 3))
        return FeatureImage(tokens[0].float().cpu().numpy(), valid, token[0].float().cpu().numpy(), stride=patch,
                            offset=0.5 * (patch - 1))

    def of_particles(self, view: View, projected: Projection) -> np.ndarray:
        """No further columns, as in the paper (n, 0)."""
        return np.zeros((len(projected.points), 0), np.float32)


def find_weights(size: str, given: str = "") -> Path:
    """The file of weights: ``given``, or the first found in $VSFSIM_DINOV2 and torch.hub's cache.

    Raises:
        VsfError: there is none; the message has the command that fetches it.
    """
    file, folder = FILES[size], os.environ.get(FOLDER_VARIABLE)
    hub = Path(torch.hub.get_dir()) / "checkpoints"
    places = [Path(given)] if given else [*([] if folder is None else [Path(folder) / file]), hub / file]
    for place in places:
        if place.is_file():
            return place
    url = _ADDRESS.format(folder=file.removesuffix("_pretrain.pth"), file=file)
    raise VsfError(f"features dinov2-{size[0]} need the published weights, which are not in "
                   f"{' or '.join(str(p) for p in places)}. This fetches them:\n\n"
                   f"  mkdir -p {hub} && curl -L -o {hub / file} {url}\n\nOr give the file: --set weights=PATH, or its "
                   f"folder in ${FOLDER_VARIABLE}. --set features=local needs no download.")


def _state(path: str) -> Mapping[str, torch.Tensor]:
    """Tensors of a checkpoint by name.

    Raises:
        VsfError: the file cannot be read, or holds something else.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its parser meets
        raise VsfError(f"weights {path} cannot be read as a torch state dict: {type(error).__name__}: "
                       f"{str(error)[:200]} Fetch the file again.") from error
    if not isinstance(state, dict):
        raise VsfError(f"weights {path} hold a {type(state).__name__}; a state dict (name -> tensor) of DINOv2 is "
                       f"wanted.")
    return state


@functools.lru_cache(maxsize=2)
def _loaded(size: str, path: str, sha256: str) -> VisionTransformer:
    """The model of a file, once for each content of it."""
    state = {name: value for name, value in _state(path).items() if name not in _UNUSED}
    model = VisionTransformer(ARCHITECTURES[size])
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise VsfError(f"weights {path} are not of DINOv2 {size} ({plain(error, longest=400)}). Give {FILES[size]}, "
                       f"without registers.") from error
    return model.eval().requires_grad_(False)
