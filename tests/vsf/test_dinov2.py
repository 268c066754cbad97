"""The DINOv2 extractor end to end on a small, randomly initialised transformer of the same architecture, saved as a
checkpoint; and the transformer against timm's."""

import numpy as np
import pytest
import torch

from references import dinov2_timm, load
from vsfsim.bench.mock import camera_view, particles
from vsfsim.core.errors import VsfError
from vsfsim.vsf.features import dinov2
from vsfsim.vsf.features.dinov2 import Architecture, VisionTransformer
from vsfsim.vsf.features.interface import projection
from vsfsim.vsf.features.registry import particle_features, view_token

torch.set_num_threads(1)
TINY = Architecture(24, 2, 3)


@pytest.fixture
def checkpoint(tmp_path, monkeypatch):
    monkeypatch.setitem(dinov2.ARCHITECTURES, "small", TINY)
    torch.manual_seed(0)
    model = VisionTransformer(TINY)
    path = tmp_path / "tiny.pth"
    torch.save(model.state_dict(), path)
    return model.eval(), path


def test_the_tokens_are_timms():
    expected = load("dinov2_timm")
    model = VisionTransformer(Architecture(dinov2_timm.WIDTH, dinov2_timm.DEPTH, dinov2_timm.HEADS,
                                           grid=dinov2_timm.GRID)).eval()
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    assert sorted(shapes) == expected["names"]
    model.load_state_dict({name: torch.from_numpy(value) for name, value in dinov2_timm.weights(shapes).items()})
    with torch.no_grad():
        token, patches = model(torch.from_numpy(dinov2_timm.image()))
    np.testing.assert_allclose(torch.cat([token, patches[0].flatten(0, 1)]), expected["tokens"], atol=1e-5)


def test_end_to_end_from_a_file(checkpoint):
    model, path = checkpoint
    view, points = camera_view(), particles()
    features = particle_features("dinov2-s", view, points, spacing=0.005, weights=str(path))
    assert features.shape == (len(points), 24) and np.isfinite(features).all()
    image = dinov2.Dinov2(model).image(view)
    # 64 px are padded to 5 patches
    assert image.values.shape == (5, 5, 24) and image.valid.any() and not image.valid.all()
    projected = projection(view, points, 0.005)
    # A particle on the centre of a patch reads that patch.
    cell = (projected.pixel - 6.5) / 14
    k = int(np.argmin(np.linalg.norm(cell - np.rint(cell), axis=1) + 9.0 * ~projected.visible))
    column, row = np.rint(cell[k]).astype(int)
    np.testing.assert_allclose(features[k], image.values[row, column], atol=0.2 * np.ptp(image.values))
    assert view_token("dinov2-s", view, weights=str(path)).shape == (24,)


def test_refusals_say_what_to_do(checkpoint, tmp_path, monkeypatch):
    model, _ = checkpoint
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "none"))
    monkeypatch.delenv("VSFSIM_DINOV2", raising=False)
    with pytest.raises(VsfError,
                       match=r"curl -L -o .*dinov2_vits14_pretrain.pth "
                             r"https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain.pth"):
        particle_features("dinov2-s", camera_view(), particles(), spacing=0.005)
    (tmp_path / "text.pth").write_text("hello")
    with pytest.raises(VsfError, match="cannot be read"):
        dinov2.Dinov2.load("small", str(tmp_path / "text.pth"))
    torch.save({**model.state_dict(), "register_tokens": torch.zeros(1)}, tmp_path / "reg.pth")
    with pytest.raises(VsfError, match=r"Unexpected key.*register_tokens"):
        dinov2.Dinov2.load("small", str(tmp_path / "reg.pth"))


def test_weights_are_found_in_the_folder_and_read_without_the_mask_token(checkpoint, tmp_path, monkeypatch):
    model, _ = checkpoint
    monkeypatch.setenv("VSFSIM_DINOV2", str(tmp_path))
    torch.save({**model.state_dict(), "mask_token": torch.zeros(1, 24)}, tmp_path / "dinov2_vits14_pretrain.pth")
    assert dinov2.find_weights("small") == tmp_path / "dinov2_vits14_pretrain.pth"
    loaded = dinov2.Dinov2.load("small").model.state_dict()
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in loaded.items())
