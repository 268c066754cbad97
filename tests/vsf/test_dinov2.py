"""The DINOv2 extractor end to end on a small, randomly initialised transformer of the same architecture, saved as a
checkpoint."""

import numpy as np
import pytest
import torch

from vsfsim.bench.mock import camera_view, particles
from vsfsim.core.errors import VsfError
from vsfsim.vsf.features import dinov2
from vsfsim.vsf.features.interface import particle_features, see, view_token
from vsfsim.vsf.features.vit import BASE, SMALL, Architecture, VisionTransformer

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


def test_names_and_shapes_are_the_published_ones():
    with torch.device("meta"):
        small, base = VisionTransformer(SMALL), VisionTransformer(BASE)
    shapes = {name: tuple(value.shape) for name, value in small.state_dict().items()}
    # Published sizes: 22.1 M parameters for ViT-S/14 and 86.6 M for ViT-B/14, the mask token included.
    assert len(shapes) == 175 and shapes["pos_embed"] == (1, 1370,
                                                          384) and shapes["patch_embed.proj.weight"] == (384, 3, 14, 14)
    block = {name.removeprefix("blocks.11."): shape for name, shape in shapes.items() if name.startswith("blocks.11.")}
    assert block == {"norm1.weight": (384,), "norm1.bias": (384,), "attn.qkv.weight": (1152, 384),
                     "attn.qkv.bias": (1152,), "attn.proj.weight": (384, 384),
                     "attn.proj.bias": (384,), "ls1.gamma": (384,), "norm2.weight": (384,), "norm2.bias": (384,),
                     "mlp.fc1.weight": (1536, 384),
                     "mlp.fc1.bias": (1536,), "mlp.fc2.weight": (384, 1536), "mlp.fc2.bias": (384,),
                     "ls2.gamma": (384,)}
    assert [round(sum(p.numel() for p in model.parameters()) / 1e6, 1) for model in (small, base)] == [22.1, 86.6]


def test_attention_is_torchs_own(checkpoint):
    model, _ = checkpoint
    attention, x = model.blocks[0].attn, torch.randn(2, 7, 24)
    theirs = torch.nn.MultiheadAttention(24, 3, batch_first=True)
    theirs.load_state_dict({"in_proj_weight": attention.qkv.weight, "in_proj_bias": attention.qkv.bias,
                            "out_proj.weight": attention.proj.weight, "out_proj.bias": attention.proj.bias})
    torch.testing.assert_close(attention(x), theirs(x, x, x, need_weights=False)[0])


def test_positions_are_stretched_over_another_grid(checkpoint):
    model, _ = checkpoint
    assert model.positions(37, 37) is model.pos_embed
    with torch.no_grad():  # a position that is linear along the rows stays so
        model.pos_embed[0, 1:] = torch.arange(37.0).repeat_interleave(37)[:, None]
    stretched = model.positions(10, 20)[0, 1:].reshape(10, 20, -1)[:, :, 0]
    torch.testing.assert_close(stretched, stretched[:, :1].expand(-1, 20))
    steps = stretched[2:8, 0].diff()
    assert steps.min() > 3.0 and steps.max() < 4.4


def test_end_to_end_from_a_file(checkpoint):
    model, path = checkpoint
    view, points = camera_view(), particles()
    features = particle_features("dinov2-s", view, points, spacing=0.005, weights=f"{path}@{dinov2.file_digest(path)}")
    assert features.shape == (len(points), 24) and np.isfinite(features).all()
    image = dinov2.Dinov2(model).image(view)
    # 64 px are padded to 5 patches
    assert image.values.shape == (5, 5, 24) and image.valid.any() and not image.valid.all()
    seen = see(view, points, 0.005)
    # A particle on the centre of a patch reads that patch.
    k = int(np.argmin(np.linalg.norm((seen.pixel - 6.5) / 14 - np.rint((seen.pixel - 6.5) / 14),
                                     axis=1) + 9.0 * ~seen.visible))
    column, row = np.rint((seen.pixel[k] - 6.5) / 14).astype(int)
    np.testing.assert_allclose(features[k], image.values[row, column], atol=0.2 * np.ptp(image.values))
    assert view_token("dinov2-s", view, weights=str(path)).shape == (24,)
    # The whole forward pass once more, by hand: first the tokens, then the pre-norm blocks.
    x = torch.randn(1, 3, 28, 42)
    with torch.no_grad():
        tokens = torch.cat([model.cls_token, model.patch_embed.proj(x).reshape(1, 24, 6).transpose(1, 2)],
                           dim=1) + model.positions(2, 3)
        for block in model.blocks:
            tokens = tokens + block.ls1.gamma * block.attn(block.norm1(tokens))
            tokens = (tokens + block.ls2.gamma
                      * block.mlp.fc2(torch.nn.functional.gelu(block.mlp.fc1(block.norm2(tokens)))))
        class_token, patches = model(x)
        torch.testing.assert_close(torch.cat([class_token[:, None], patches.reshape(1, 6, 24)], dim=1),
                                   model.norm(tokens))


def test_refusals_say_what_to_do(checkpoint, tmp_path, monkeypatch):
    model, path = checkpoint
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "none"))
    monkeypatch.delenv("VSFSIM_DINOV2", raising=False)
    with pytest.raises(VsfError,
                       match=r"curl -L -o .*dinov2_vits14_pretrain.pth "
                             r"https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain.pth"):
        particle_features("dinov2-s", camera_view(), particles(), spacing=0.005)
    with pytest.raises(VsfError, match="dinov2_vitb14"):
        dinov2.Dinov2.load("base")
    with pytest.raises(VsfError, match=r"have the sha256 .* not 00ff"):
        dinov2.Dinov2.load("small", f"{path}@00ff")
    (tmp_path / "text.pth").write_text("hello")
    with pytest.raises(VsfError, match="cannot be read"):
        dinov2.Dinov2.load("small", str(tmp_path / "text.pth"))
    torch.save({**model.state_dict(), "register_tokens": torch.zeros(1)}, tmp_path / "reg.pth")
    with pytest.raises(VsfError, match="unknown: register_tokens"):
        dinov2.Dinov2.load("small", str(tmp_path / "reg.pth"))
    torch.save({**model.state_dict(), "cls_token": torch.zeros(1, 1, 5)}, tmp_path / "wrong.pth")
    with pytest.raises(VsfError, match=r"wrong shape: cls_token \(1, 1, 5\) instead of \(1, 1, 24\)"):
        dinov2.Dinov2.load("small", str(tmp_path / "wrong.pth"))


def test_weights_are_found_in_the_usual_places(checkpoint, tmp_path, monkeypatch):
    _, path = checkpoint
    hub = tmp_path / "torch" / "hub" / "checkpoints"
    hub.mkdir(parents=True)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    (hub / "dinov2_vits14_pretrain.pth").write_bytes(path.read_bytes())
    assert dinov2.find_weights("small") == hub / "dinov2_vits14_pretrain.pth"
    own = tmp_path / "own"
    own.mkdir()
    (own / "dinov2_vits14_pretrain.pth").write_bytes(path.read_bytes())
    monkeypatch.setenv("VSFSIM_DINOV2", str(own))
    assert dinov2.find_weights("small") == own / "dinov2_vits14_pretrain.pth"
