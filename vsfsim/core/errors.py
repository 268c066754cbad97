"""Errors a user can act on: where it happened, what was given, what is allowed, what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path


class VsfsimError(Exception):
    """A mistake in the input or the surroundings; its message is one paragraph.

    The command line prints the message and exits with code 2; ``--debug`` shows the traceback.
    Bugs of our own are ``AssertionError`` and the like, never this class.
    """


class SceneError(VsfsimError):
    """A scene file says something that cannot be built."""


class MeshError(VsfsimError):
    """A surface mesh cannot be read, repaired or filled with tetrahedra."""


class DatasetError(VsfsimError):
    """A dataset is missing, damaged, of another scene, or cannot be written."""


class TaskError(VsfsimError):
    """A task file, or what it asks for, does not fit."""


class MethodError(VsfsimError):
    """A method is unknown, does not conform, or returned something that cannot be scored."""


class VsfError(VsfsimError):
    """The VSF model was given something it cannot work with."""


class Interrupted(VsfsimError):
    """The user has stopped a command; the message says what is kept and how to go on. Exit code 130."""


class Terminated(KeyboardInterrupt):
    """A scheduler has ended a command by SIGTERM: what is under way is dropped as by Ctrl-C. Exit code 143."""


class NoStiffnessError(VsfError):
    """The forces of all touches are zero or pull, so that no stiffness can be estimated from them."""


def did_you_mean(given: str, allowed: Iterable[str]) -> str:
    """A sentence that names the nearest allowed word, or lists all of them.

    Args:
        given: the word the user wrote.
        allowed: the words that would have been understood.
    """
    names = sorted(str(name) for name in allowed)
    near = [one for word in (str(given), str(given).lower())  # a number reaches this, too: --set structure=5
            for one in difflib.get_close_matches(word, names, n=1, cutoff=0.6)]
    return (f"Did you mean '{near[0]}'? " if near else "") + f"Allowed: {', '.join(names) or '(none)'}."


def one_of(given: str, allowed: Iterable[str], what: str, error: type[VsfsimError] = VsfsimError) -> str:
    """``given`` if it is one of ``allowed``; ``what`` begins the message.

    Raises:
        VsfsimError: of class ``error``; it is not.
    """
    names = tuple(allowed)
    if given not in names:
        raise error(f"{what} is {given!r}. {did_you_mean(str(given), names)}")
    return given


def no_such_file(kind: str, given: str | Path) -> str:
    """The message for a path that leads nowhere: where it stops, and the nearest name there.

    Args:
        kind: what was wanted, e.g. "scene file".
        given: the path.
    """
    path = Path(given)
    parent = path.parent
    if path.exists():
        return f"'{path}' is a {'folder' if path.is_dir() else 'file'}, not a {kind}."
    if not parent.is_dir():
        return f"there is no {kind} '{path}': there is no folder '{parent}'."
    names = sorted(found.name for found in parent.iterdir() if not found.name.startswith("."))
    near = difflib.get_close_matches(path.name, names, n=1, cutoff=0.6)
    hint = f" Did you mean '{parent / near[0]}'?" if near else f" Nothing in '{parent.resolve()}' has a similar name."
    return f"there is no {kind} '{path}'.{hint}"
