"""DINOv2 features of a view (SBML appendix B.2): patch tokens of a pretrained vision transformer, from weights on this
machine.

Nothing is downloaded here. Weights are looked for where the user says, in $VSFSIM_DINOV2, and in the cache of
torch.hub; the error that says they are missing prints the command that fetches them. They are read as plain tensors (no
code in them is run), must fit the architecture name for name, and `sha256` of the file can be demanded.
"""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from vsfsim.core.errors import VsfError
from vsfsim.data.records import View
from vsfsim.vsf.features.interface import FeatureImage, Geometry
from vsfsim.vsf.features.vit import BASE, SMALL, Architecture, VisionTransformer

ARCHITECTURES: dict[str, Architecture] = {"small": SMALL, "base": BASE}
FILES = {"small": "dinov2_vits14_pretrain.pth", "base": "dinov2_vitb14_pretrain.pth"}
"""File names of the published weights."""

_ADDRESS = "https://dl.fbaipublicfiles.com/dinov2/{folder}/{file}"
FOLDER_VARIABLE = "VSFSIM_DINOV2"
# Colour statistics the model was trained with.
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
            weights: a .pth file, optionally followed by ``@`` and the sha256 it must have; "" searches $VSFSIM_DINOV2
            and torch.hub's cache.
            device: torch device.

        Raises:
            VsfError: no weights, a wrong checksum, or a file that is not of this architecture.
        """
        name, _, wanted = str(weights).partition("@")
        path = find_weights(size, name)
        model = _loaded(size, str(path), path.stat().st_mtime_ns, wanted.lower())
        return cls(model, device=device)

    @torch.no_grad()
    def image(self, view: View) -> FeatureImage:
        """Patch tokens, one cell a patch of 14 x 14 pixels; patches that see the object are valid (h, w, D)."""
        patch = self.model.architecture.patch
        height, width = view.mask.shape
        # Bottom and right are padded to whole patches, so that cell (i, j) keeps its place in the image.
        pad = (0, -width % patch, 0, -height % patch)
        rgb = torch.tensor(np.array(view.rgb), dtype=torch.float32, device=self.device).permute(2, 0, 1) / 255.0
        rgb = (rgb - torch.tensor(_MEAN, device=self.device)[:, None,
                                                             None]) / torch.tensor(_STD,
                                                                                   device=self.device)[:, None, None]
        token, tokens = self.model(functional.pad(rgb, pad)[None])
        mask = np.pad(np.asarray(view.mask, bool), ((0, pad[3]), (0, pad[1])))
        valid = np.any(mask.reshape(mask.shape[0] // patch, patch, -1, patch), axis=(1, 3))
        return FeatureImage(tokens[0].float().cpu().numpy(), valid, token[0].float().cpu().numpy(), stride=patch,
                            offset=0.5 * (patch - 1))

    def of_particles(self, view: View, geometry: Geometry) -> np.ndarray:
        """Nothing beside the image, as in the paper (n, 0)."""
        return np.zeros((len(geometry.points), 0), np.float32)


def find_weights(size: str, given: str = "") -> Path:
    """The file of weights.

    Raises:
        VsfError: there is none; the message has the command that fetches it.
    """
    file = FILES[size]
    hub = Path(os.environ.get("TORCH_HOME",
                              Path(os.environ.get("XDG_CACHE_HOME",
                                                  Path.home() / ".cache")) / "torch")) / "hub" / "checkpoints"
    if given:
        places = [Path(given)]
    else:
        places = [Path(os.environ[FOLDER_VARIABLE]) / file] if FOLDER_VARIABLE in os.environ else []
        places.append(hub / file)
    for place in places:
        if place.is_file():
            return place
    url = _ADDRESS.format(folder=file.removesuffix("_pretrain.pth"), file=file)
    raise VsfError(f"features dinov2-{size[0]} need the published weights, which are not in "
                   f"{' or '.join(str(p) for p in places)}. This fetches them:\n\n"
                   f"  mkdir -p {hub} && curl -L -o {hub / file} {url}\n\nOr give the file: --set weights=PATH, or its "
                   f"folder in ${FOLDER_VARIABLE}. "
                   "--set features=local needs no download.")


@functools.lru_cache(maxsize=2)
def _loaded(size: str, path: str, _changed: int, wanted: str) -> VisionTransformer:
    if wanted:
        found = file_digest(path)
        if found != wanted:
            raise VsfError(f"weights {path} have the sha256 {found}, not {wanted}. The file is another one or was cut "
                           f"short; fetch it again.")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler meets
        raise VsfError(f"weights {path} cannot be read as a torch state dict: {type(error).__name__}: "
                       f"{str(error)[:200]} Fetch the file again.") from error
    model = VisionTransformer(ARCHITECTURES[size])
    own = model.state_dict()
    if not isinstance(state, dict):
        raise VsfError(f"weights {path} hold a {type(state).__name__}; a state dict (name -> tensor) of DINOv2 "
                       f"{size} is wanted.")
    missing, extra = sorted(set(own) - set(state)), sorted(map(str, set(state) - set(own)))
    wrong = [f"{k} {tuple(state[k].shape)} instead of {tuple(v.shape)}" for k,
             v in own.items() if k in state and state[k].shape != v.shape]
    if missing or extra or wrong:
        words = [f"missing: {', '.join(missing[:3])}" * bool(missing), f"unknown: {', '.join(extra[:3])}" * bool(extra),
                 f"wrong shape: {', '.join(wrong[:3])}" * bool(wrong)]
        raise VsfError(f"weights {path} are not of DINOv2 {size} ({'; '.join(w for w in words if w)}). Give "
                       f"{FILES[size]}, without registers.")
    model.load_state_dict(state)
    return model.eval().requires_grad_(False)


def file_digest(path: str | Path) -> str:
    """sha256 of a file's bytes, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
