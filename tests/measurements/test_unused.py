"""`vsfsim measure unused`: what counts as run."""

import importlib.util

import pytest
import warp as wp

from measurements.unused import functions, unused, watched

MODULE = '''
import warp as wp

class A:
    def run(self):
        return [k for k in (self.inner(), self.made()())]
    def inner(self): ...
    def made(self):
        def closure(): return 1
        return closure
    def idle(self): ...

@wp.func
def deep(x: float): return x
@wp.func
def shallow(x: float): return deep(x)
@wp.func
def unasked(x: float): return deep(x)
@wp.kernel
def asked(x: wp.array(dtype=float)):
    x[0] = shallow(1.0)
@wp.kernel
def left(x: wp.array(dtype=float)):
    x[0] = unasked(1.0)
'''


@pytest.fixture
def toy(tmp_path):
    path = tmp_path / "toy.py"
    path.write_text(MODULE)
    spec = importlib.util.spec_from_file_location("toy", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_is_called_launched_or_named_by_such_counts(toy, tmp_path, monkeypatch):
    monkeypatch.setattr(wp, "launch", lambda kernel, **_: None)
    with watched() as ran:
        toy.A().run()
        wp.launch(toy.asked, dim=1)
    found = functions(tmp_path)
    assert len(found) == 10 and {one.name for one in found if one.compiled} == {
        "deep", "shallow", "unasked", "asked", "left"}
    assert {one.name for one in unused(found, ran)} == {"A.idle", "unasked", "left"}
