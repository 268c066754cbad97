"""Tokens of timm's DINOv2 transformer on given weights: the reference of tests/vsf/test_dinov2.py.

Run in an environment with timm and torchvision (this project needs neither):

    pip install timm==1.0.31 && python references/dinov2_timm.py

It writes dinov2_timm.json: the tokens of a narrow transformer of the architecture (24 numbers a token,
2 blocks, 3 heads, 3 x 3 patches) on the weights and the image of `weights` and `image`. On ViT-S/14 at 518 px with
random weights the largest difference from `vsfsim.vsf.features.dinov2` was 2.2e-6, at a mean token size of 0.80.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

WIDTH, DEPTH, HEADS, PATCH, GRID = 24, 2, 3, 14, 3


def weights(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Random weights for a state dict of these shapes, the same for the same names and shapes."""
    rng = np.random.default_rng(0)
    return {name: rng.normal(0.0, 0.3, shapes[name]).astype(np.float32) for name in sorted(shapes)}


def image() -> np.ndarray:
    """A normalised image (1, 3, 42, 42)."""
    return np.random.default_rng(1).normal(size=(1, 3, GRID * PATCH, GRID * PATCH)).astype(np.float32)


def main() -> None:
    """Write the tokens (10, 24), class token first."""
    import timm
    import torch

    model = timm.models.vision_transformer.VisionTransformer(
        img_size=GRID * PATCH, patch_size=PATCH, embed_dim=WIDTH, depth=DEPTH, num_heads=HEADS, init_values=1e-5,
        num_classes=0).eval()
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    model.load_state_dict({name: torch.from_numpy(value) for name, value in weights(shapes).items()})
    with torch.no_grad():
        tokens = model.forward_features(torch.from_numpy(image()))[0]
    origin = f"references/dinov2_timm.py with timm {timm.__version__}, torch {torch.__version__}"
    table = {"origin": origin, "names": sorted(shapes), "tokens": np.round(tokens.double().numpy(), 6).tolist()}
    Path(__file__).with_suffix(".json").write_text(json.dumps(table) + "\n")


if __name__ == "__main__":
    main()
