"""What is compiled for a GPU, on a machine that need not have one."""

from types import SimpleNamespace

import pytest
import warp as wp

from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.effector import kernels_of
from vsfsim.physics import runtime

SCENES = "shoes-v3-mini", "shoes-v2-punyo-mini", "plants-v5-mini"  # solids, a bubble, plants


@pytest.mark.slow
def test_every_kernel_of_a_scene_compiles_for_a_gpu(monkeypatch, tmp_path):
    found = {}  # those that `compile_kernels` loads on a GPU
    with monkeypatch.context() as patch:
        patch.setattr(runtime, "check_device", lambda device: None)
        patch.setattr(wp, "get_device", lambda device: SimpleNamespace(is_cpu=False, alias=device))
        patch.setattr(wp.Module, "load", lambda module, **_: found.setdefault(module.name, module))
        for scene in SCENES:
            runtime.compile_kernels(kernels_of(load_scene(find_scene(scene)).sample(0), "float64"), "cuda:0")
    # NVRTC compiles for a Hopper card wherever Warp is installed
    for name, module in found.items():
        wp.compile_aot_module(module, arch=90, module_dir=tmp_path / name, use_ptx=True)
        assert list((tmp_path / name).glob("*.ptx")), name
