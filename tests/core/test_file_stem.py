"""Names of results become names of files that stay apart."""

import pytest

from vsfsim.cli.options import result_path
from vsfsim.core.errors import VsfsimError
from vsfsim.core.plain_text import file_stem


def test_names_of_other_alphabets_and_long_ones_stay_apart():
    names = ["\u65b9\u6cd5", "\u65b9\u6848", "m\u00e9thode", "m\u00e8thode", "x" * 300, "x" * 299 + "y",
             "mine", "my.mine"]
    stems = [file_stem(name) for name in names]
    assert len(set(stems)) == len(names) and all(stem.isascii() and len(stem) < 120 for stem in stems)
    assert stems[-2:] == ["mine", "my.mine"] and stems[0].startswith("unnamed-") and file_stem("") == "unnamed"


@pytest.mark.parametrize("name", ["x" * 300 + ".json", "\u65b9" * 90 + ".json", "x" * 300 + "/r.json"])
def test_an_out_with_a_name_that_no_file_can_have_is_refused(name, tmp_path):
    with pytest.raises(VsfsimError, match=r"a name of \d+ letters; a file name has at most 200 bytes"):
        result_path(tmp_path / name, "toy-v1", "mine")
    assert result_path(None, "toy-v1", "x" * 300).name.endswith(".json")
