"""`vsfsim new-method NAME`: a package with a method that runs, its entry point and its test."""

from __future__ import annotations

import re
from pathlib import Path

from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import METHOD_GROUP, methods
from vsfsim.data.disk import write_atomic

PROJECT = """\
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "{name}"
version = "0.1.0"
description = "A stiffness estimator for vsfsim"
requires-python = ">=3.11"
dependencies = ["vsfsim", "numpy"]

[project.optional-dependencies]
test = ["pytest"]

# vsfsim finds the method by this entry point once the package is installed.
[project.entry-points."{group}"]
{name} = "{module}:{classname}"

[tool.setuptools]
py-modules = ["{module}"]

[tool.pytest.ini_options]
pythonpath = ["."]
"""

METHOD = '''\
"""{name}: springs under the surface; a touch is predicted from the touches near it and from the training objects."""

import numpy as np

from vsfsim.core.errors import MethodError


class {classname}:
    """A method is any class with three functions: meta_fit, adapt and predict. There is nothing to inherit from.

    Args:
        reach: distance over which a touch tells about its surroundings [m].
        trust: weight of the training objects against the touches of a new one [m^2].
    """

    def __init__(self, *, reach: float = 0.02, trust: float = 1e-4):
        self.reach, self.trust = reach, trust

    def meta_fit(self, specimens):
        """Learn from the training objects; each has .view and .touches (with .action, .value, .valid)."""
        springs = [spring(specimen.view, touch) for specimen in specimens for touch in specimen.touches]
        self.prior = sum(a for _, a, _ in springs) / max(sum(b for _, _, b in springs), 1e-12)

    def adapt(self, view, support):
        """A new object: its view, and 0 or more touches of it. Start from what meta_fit learned."""
        self.view, self.near = view, [spring(view, touch) for touch in support]

    def predict(self, touches):
        """Touches that were not made yet -> their readings, one array (T, d) a touch."""
        return [self.reading(*contact(self.view, action)) for action in touches]

    def reading(self, place, depth):
        """Readings (T, d) of a touch at ``place`` (3,) [m] that goes ``depth`` (T,) [m] deep."""
        above, below = self.trust * self.prior, self.trust
        for there, a, b in self.near:
            weight = np.exp(-0.5 * np.sum((place - there) ** 2) / self.reach**2)
            above, below = above + weight * a, below + weight * b
        return np.outer(depth, above / below)


def contact(view, action):
    """Where a ball comes closest to the visible surface (3,) [m], and how far past it in each frame (T,) [m]."""
    points = view.points()
    away = np.linalg.norm(action.poses[:, None, :3, 3] - points[None], axis=2)
    radius = getattr(action.probe, "radius", 0.0)   # the probe is a ball in the tasks with shoes
    return points[away.min(axis=0).argmin()], np.maximum(radius - away.min(axis=1), 0.0)


def spring(view, touch):
    """Place of a touch, and the sums of readings times depth (d,) and of depth squared over its frames."""
    place, depth = contact(view, touch.action)
    depth, value = depth[touch.valid], touch.value[touch.valid]     # frames without a reading hold NaN
    if not np.isfinite(value).all():
        raise MethodError("a reading is not a number in a frame that is marked as valid")
    return place, depth @ value, depth @ depth
'''

TEST = '''\
"""The contract of a method, on mock objects (seconds), and one property of this one."""

import re

import pytest

from vsfsim.bench.check import check


@pytest.fixture(scope="module")
def findings():
    return check("{module}:{classname}")


def test_it_keeps_the_contract(findings):
    assert [f for f in findings if f.outcome == "failed"] == []


def test_it_knows_more_than_nothing(findings):
    """On the mock object, its error is smaller than that of always answering 0, before any touch and after five."""
    for finding in findings:
        if finding.detail.startswith("rmse"):
            error, zero = (float(word) for word in re.findall(r"(\\d+\\.\\d+) N", finding.detail))
            assert error < 0.9 * zero, finding
'''

README = """\
# {name}

A stiffness estimator for [vsfsim](https://pypi.org/project/vsfsim). The method is in `{module}.py`.

```bash
pip install -e ".[test]"
pytest
vsfsim check {name}
vsfsim evaluate --method {name} --task fewshot-shoes-v3-mini-v1
vsfsim leaderboard --task fewshot-shoes-v3-mini-v1
```
"""


def write_package(name: str, out: Path | None = None) -> str:
    """Write the package of a new method.

    Args:
        name: of the method.
        out: folder to make, or None for ``name`` in the current one.

    Returns:
        What was written and the next steps, to be printed.

    Raises:
        MethodError: the name cannot be that of a method and a package, it is taken, or the folder is not empty.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise MethodError(f"the name of a method is {name!r}; give small letters, digits and single dashes that begin "
                          f"with a letter, e.g. my-method.")
    if name in methods():
        raise MethodError(f"there is a method '{name}' already ({methods()[name].value}). Choose another name.")
    folder = out or Path(name)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise MethodError(f"'{folder}' exists and is {'not empty' if folder.is_dir() else 'a file'}. Choose another "
                          f"place by --out, or remove it.")
    words = name.split("-")
    module = "_".join(words)
    values = {"name": name, "module": module, "group": METHOD_GROUP, "classname": "".join(w.title() for w in words)}
    for path, text in (("pyproject.toml", PROJECT), (f"{module}.py", METHOD), (f"tests/test_{module}.py", TEST),
                       ("README.md", README)):
        file = folder / path
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MethodError(f"folder {file.parent} cannot be made: {error.strerror}. Choose another "
                              f"--out.") from error
        write_atomic(file, text.format(**values).encode(), error=MethodError)
    return (f"written to {folder}: {module}.py (the method), its test, pyproject.toml with the entry point\n\n"
            f"  cd {folder}\n  vsfsim check {module}:{values['classname']}    # before it is installed\n"
            f"  pip install -e \".[test]\" && pytest\n"
            f"  vsfsim evaluate --method {name} --task fewshot-shoes-v3-mini-v1")
