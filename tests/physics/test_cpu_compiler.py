"""A Warp that cannot compile for the CPU, and a disk for temporary files that is full."""

import errno
import sys

import pytest
import warp as wp

import vsfsim.cli.main as cli
from vsfsim.core.errors import VsfsimError
from vsfsim.physics.runtime import check_device, compile_kernels


def test_a_warp_without_its_compiler_for_the_cpu_is_named(monkeypatch):
    check_device("cpu")
    monkeypatch.setattr(wp, "is_cpu_available", lambda: False)
    for ask in (lambda: check_device("cpu"), lambda: compile_kernels([], "cpu")):
        with pytest.raises(VsfsimError, match="no compiler for the CPU"):
            ask()


@pytest.mark.parametrize(("error", "said"), [
    (OSError(errno.ENOSPC, "No space left on device"), "a temporary file cannot be written: No space left"),
    (FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/full']"), "TMPDIR is '/full'"),
    (OSError(errno.ENAMETOOLONG, "File name too long", "n" * 300), "is too long for this system"),
])
def test_a_full_folder_of_temporary_files_and_a_name_too_long_are_no_bugs(monkeypatch, capsys, error, said):
    def fail():
        raise error

    monkeypatch.setattr(cli.typer.main, "get_command", lambda app: type("Command", (), {
        "commands": {"press": None}, "__call__": lambda self, **_: fail()})())
    monkeypatch.setattr(sys, "argv", ["vsfsim", "press"])
    monkeypatch.setenv("TMPDIR", "/full")
    with pytest.raises(SystemExit) as stop:
        cli.main()
    words = capsys.readouterr().err
    assert stop.value.code == 2 and said in words and "bug" not in words
