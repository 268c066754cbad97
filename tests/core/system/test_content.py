"""What decides a result is found by content, without importing any of it."""

import os

from vsfsim.core.system.content import differences, files_sha256, named_files, source_files, source_sha256


def write(folder, **files):
    for name, text in files.items():
        path = folder / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".py").write_text(text)


def test_the_source_is_all_that_is_imported_at_any_depth(tmp_path):
    write(tmp_path, mine="import numpy\nfrom parts import deep\n\n\ndef late():\n    import helper\n",
          helper="raise RuntimeError('never imported')\n", parts__deep="from . import other\n",
          parts__other="A = 1\n", stranger="B = 2\n")
    (tmp_path / "parts" / "__init__.py").write_text("")
    assert sorted(source_files("mine", tmp_path)) == ["helper", "mine", "parts", "parts.deep", "parts.other"]
    before = files_sha256(source_files("mine", tmp_path))
    write(tmp_path, stranger="B = 3\n")
    assert files_sha256(source_files("mine", tmp_path)) == before
    write(tmp_path, parts__other="A = 2\n")
    assert files_sha256(source_files("mine", tmp_path)) != before
    assert source_sha256("there_is_none_of_this_name") == ""


def test_a_module_that_is_replaced_under_the_same_time_stamp_is_the_new_one(tmp_path):
    for text, used in (("import one\n", "one"), ("import two\n", "two")):
        write(tmp_path, changing=text, one="", two="")
        os.utime(tmp_path / "changing.py", (1.7e9, 1.7e9))
        assert set(source_files("changing", tmp_path)) == {"changing", used}


def test_files_are_found_by_the_texts_that_name_them(tmp_path):
    (tmp_path / "ball.stl").write_text("x")
    tree = {"object": {"shape": {"mesh": "ball.stl"}}, "parts": [{"name": "a" * 500},
                                                                     {"mesh": f"{tmp_path}/ball.stl"}],
            "other": "\0", "kernel": "/proc/self/environ", "number": 3, "folder": "."}
    assert set(named_files(tree, tmp_path)) == {"ball.stl", f"{tmp_path}/ball.stl"}


def test_differences_are_told_by_name():
    assert differences({"a": "1" * 64, "b": "2"}, {"a": "3" * 64, "c": "4"}) == [
        "a has another content (sha256 111111111111 there, 333333333333 here)", "c was not recorded there",
        "b is not found here"]
    assert differences({"a": "1"}, {"a": "1"}) == []
