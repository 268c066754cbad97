import functools

import pytest
import texts

from vsfsim.core.scene import load_scene
from vsfsim.generate.run import generate
from vsfsim.generate.workers import make_one


def make_here(patch):
    """Views are made in this process, one after the other: a new one imports the libraries for seconds."""
    def make_each(jobs, *, device, **_):
        for job in jobs:
            make_one(job, device)
            yield job.name

    for module in ("on_solids", "effectors.arm"):
        patch.setattr(f"vsfsim.generate.{module}.make_each", make_each)


@pytest.fixture
def here(monkeypatch):
    make_here(monkeypatch)


@pytest.fixture(scope="session")
def loaded(tmp_path_factory):
    """Loads a scene of `tests/texts`, changed, from a file of its own."""
    def load(name, /, *pairs, **values):
        path = tmp_path_factory.mktemp(name) / f"{name}.toml"
        path.write_text(texts.text(name, *pairs, **values))
        return load_scene(path)

    return load


@pytest.fixture(scope="session")
def generated(loaded):
    """Makes the dataset of such a scene in this process, once for all tests of it."""
    @functools.cache
    def make(*scene, **values):
        found = loaded(*scene, **values)
        with pytest.MonkeyPatch.context() as patch:
            make_here(patch)
            return generate(found, found.path.parent / "data")

    return make
