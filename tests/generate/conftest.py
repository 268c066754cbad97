import functools

import pytest
import texts

from vsfsim.core.scene import load_scene
from vsfsim.generate.run import generate


@pytest.fixture(scope="session")
def loaded(tmp_path_factory):
    """Loads a scene of `tests/texts`, changed, from a file of its own."""
    def load(name, /, *pairs, **values):
        path = tmp_path_factory.mktemp(name) / f"{name}.toml"
        path.write_text(texts.text(name, *pairs, **values))
        return load_scene(path)

    return load


@pytest.fixture(scope="session")
def generated(loaded, make_here):
    """Makes the dataset of such a scene in this process, once for all tests of it."""
    @functools.cache
    def make(*scene, **values):
        found = loaded(*scene, **values)
        with pytest.MonkeyPatch.context() as patch:
            make_here(patch)
            return generate(found, found.path.parent / "data")

    return make
