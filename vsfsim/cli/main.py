"""The entry point: commands are small functions that call one function of a layer, imported when they run.

Nothing heavy is imported here: `vsfsim --help` must answer within 0.3 s. A `VsfsimError` becomes one paragraph on
stderr and exit code 2; any other exception is a bug and keeps its traceback, exit code 1.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import traceback
from typing import Annotated, Any

import typer

from vsfsim.cli import bench, data, info, lab, simulate
from vsfsim.cli.cluster import ASKED, DIVIDED, Machines
from vsfsim.cli.lab import WholeSentences
from vsfsim.cli.options import command
from vsfsim.core.errors import Interrupted, Terminated, VsfsimError, did_you_mean, one_of
from vsfsim.core.extras import missing

app = typer.Typer(name="vsfsim", cls=WholeSentences, no_args_is_help=True, rich_markup_mode=None,
                  pretty_exceptions_enable=False, context_settings={"help_option_names": ["-h", "--help"]},
                  help="""Simulated vision and touch of heterogeneous deformable objects, and a benchmark of stiffness
estimators.""", epilog="Exit codes: 0 success, 1 a bug in vsfsim, 2 a mistake in the input, 3 a press that did not "
                         "converge, 4 object views that failed twice were left out, 130 interrupted, 143 ended by "
                         "SIGTERM.")

for group in (simulate, data, bench, info):
    app.add_typer(group.app)  # without a name: its commands are the app's own
for name, of in (("lab", lab.lab), ("measure", lab.measure), ("papers", lab.papers)):
    app.add_typer(of, name=name)


@command(app, context_settings={"allow_interspersed_args": False, "ignore_unknown_options": True})
def cluster(machines: Machines, words: Annotated[list[str], typer.Argument(metavar="COMMAND")]) -> None:
    """Make the parts of generate or evaluate on several machines.

    \b
      vsfsim cluster --shard 0/4 generate shoes-v3 --out /shared/shoes     # on one machine, 1/4 on the next, ...
      vsfsim cluster --on slurm --shards 50 generate shoes-v3 --out /shared/shoes

    The same command without `cluster` ends the work, when all shards are made.

    Args:
        words: The command and its options.
    """
    one_of(words[0], DIVIDED, "The command of `vsfsim cluster`")
    machines.fan()
    before = ASKED.set((machines, words))
    try:
        typer.main.get_command(app)(words, prog_name="vsfsim")
    finally:
        ASKED.reset(before)


def main() -> None:
    """Entry point of the `vsfsim` command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Unicode shows a question mark
    stopped: list[int] = []

    def stop_once(number: int, frame: Any) -> None:
        stopped.append(number)
        signal.default_int_handler(number, frame)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, stop_once)
    # Taken out by hand, so that it works before and after the command.
    debug = "--debug" in sys.argv[1:]
    sys.argv[1:] = [word for word in sys.argv[1:] if word != "--debug"]
    command: Any = typer.main.get_command(app)  # a group; get_group leaves out the options of completion
    word = sys.argv[1] if len(sys.argv) > 1 else "-"
    try:
        if word in lab.OLD:
            raise VsfsimError(f"`vsfsim {word}` is now `vsfsim {lab.OLD[word]}`.")
        if not word.startswith("-") and word not in command.commands:
            raise VsfsimError(f"unknown command '{word}'. {did_you_mean(word, command.commands)}")
        command(prog_name="vsfsim")
    except SystemExit:  # which typer makes of Ctrl-C
        if not stopped:
            raise
        print("\ninterrupted", file=sys.stderr)
        sys.exit(130)
    except Interrupted as stop:
        print(f"\n{stop}", file=sys.stderr)
        sys.exit(143 if isinstance(stop.__cause__, Terminated) else 130)
    except BrokenPipeError:
        sys.stderr.close()  # The reader of a pipe has left; nothing is wrong.
        sys.exit(0)
    except Exception as error:
        if stopped:  # some libraries turn Ctrl-C while they are imported into an error of their own
            print("\ninterrupted", file=sys.stderr)
            sys.exit(130)
        if (said := _said(error)) is None or debug:
            traceback.print_exc()
        our_bug = "this is a bug in vsfsim, not in what you gave it. Please report it with the lines above."
        print(f"error: {said or our_bug}", file=sys.stderr)
        sys.exit(1 if said is None else 2)


def _said(error: Exception) -> str | None:
    """What the user can do about an error; None for a bug of ours."""
    if isinstance(error, VsfsimError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        found = missing(error)
        return None if found is None else str(found)
    if not isinstance(error, OSError):
        return None
    if error.errno == errno.ENAMETOOLONG:
        return (f"the name '{str(error.filename)[:60]}...' is too long for this system, which allows 255 bytes a name; "
                f"use a shorter one.")
    nowhere = "No usable temporary directory" in str(error)
    if nowhere or (error.filename is None and error.errno == errno.ENOSPC):
        return (f"a temporary file cannot be written: {error.strerror}. TMPDIR is "
                f"'{os.environ.get('TMPDIR', '/tmp')}': free some space there, or export TMPDIR with a folder that "
                f"has some.")
    if error.errno not in _DISK:
        return None
    return (f"{error.filename or 'a file'} cannot be written: {error.strerror}. Free some space, or choose another "
            f"place, and run the same command again.")


_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES)
"""Errors of a full or read-only disk, raised by libraries that write pictures or temporary files."""


@app.callback(invoke_without_command=True)
def _global(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
            version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False) -> None:
    if version:
        import vsfsim

        print(f"vsfsim {vsfsim.__version__}")
        raise typer.Exit
