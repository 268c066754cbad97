"""What a container shows: the system's libraries, Python, installed packages, vsfsim's code, the method's source, GPUs,
and the files and folders that its parameters name."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import vsfsim
from vsfsim.bench.identity import files_of, imports_of, packages_of
from vsfsim.core.shelf import folder
from vsfsim.core.system.content import named_files

_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/etc", "/opt", "/nix", "/gnu", "/sys")
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/nvidia*", "/dev/dri",
            "/dev/kfd", "/dev/dxg")


def kernels() -> str:
    """The user's folder of compiled kernels."""
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return os.path.realpath(os.environ.get("WARP_CACHE_PATH") or os.path.join(cache, "warp"))


def places(name: str, parameters: Mapping[str, Any], *, search: Iterable[str], hidden: Iterable[Path],
           given: Mapping[str, str]) -> dict[str, Any]:
    """The operand of `vsfsim.bench.isolation.box.enter`, without its root and the size of its folder.

    Args:
        name, parameters: of the method. search: the folders of ``sys.path``. hidden: folders that appear empty even if
        they lie in one that is shown. given: its environment, which says where weights are.
    """
    files, here = files_of(name), os.getcwd()
    # pip installs into a folder of one of these names, or into any other, beside the package's metadata
    installed = [path for path in search if Path(path).name in ("site-packages", "dist-packages")
                 or any(Path(path).glob("*.dist-info"))]
    modules = [path for module, path in files.items() if not module.startswith("vsfsim.")]
    # a package that is installed "editable" lies where no folder of installed packages is
    editable = [Path(*path.parts[:len(path.parts) - module.count(".") - (path.name == "__init__.py")])
                for module, path in imports_of(name).items() if not module.startswith("vsfsim")]
    texts = [text for text in parameters.values() if isinstance(text, str) and "/" in text and len(text) < 1000]
    named = [*named_files(dict(parameters), here).values(),
             *(path for path in (Path(here, text) for text in texts) if path.is_dir())]
    weights = [given["VSFSIM_DINOV2"]] if "VSFSIM_DINOV2" in given else []
    weights += [os.path.join(given[key], "hub") for key in ("TORCH_HOME", "HF_HOME")]
    wanted = [*_SYSTEM, sys.prefix, sys.base_prefix, sys.exec_prefix, *installed, *vsfsim.__path__, folder("baselines"),
              *packages_of(files), *modules, *editable, *named, *weights, kernels(),
              *filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(":"))]
    apart = {"/", os.path.expanduser("~"), "/tmp", "/home", *(path for path in _SYSTEM if os.path.islink(path))}
    paths = {form(path) for path in map(str, wanted) for form in (os.path.realpath, os.path.abspath)} - apart
    devices = {path for pattern in _DEVICES for path in glob.glob(pattern)}
    return {"shown": sorted({path for path in paths if os.path.exists(path)
                             and not path.startswith(("/proc", "/dev"))} | devices),
            "links": [(path, os.readlink(path)) for path in _SYSTEM if os.path.islink(path)],
            "hidden": [os.path.realpath(path) for path in hidden if path.is_dir()]}
