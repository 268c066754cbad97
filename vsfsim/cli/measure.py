"""`vsfsim measure ...`: time and error, measured by the scripts in `measurements/` of a checkout, whose commands are in
`measurements/commands.py`."""

from __future__ import annotations

import functools
import importlib
from collections.abc import MutableMapping
from typing import Any

import typer

from vsfsim.cli.console import note
from vsfsim.cli.groups import WholeSentences
from vsfsim.core.shelf import checkout

OLD_NAME = "bench"
"""The spelling of `vsfsim measure` up to version 0.1; it works, with a note, until the release after this one."""


@functools.cache
def _commands() -> dict[str, Any]:
    """The commands of the checkout by their names, imported when one is asked for."""
    checkout()
    return dict(typer.main.get_group(importlib.import_module("measurements.commands").app).commands)


class _Group(WholeSentences):
    """A group whose commands are those of the checkout."""

    @property
    def commands(self) -> MutableMapping[str, Any]:  # type: ignore[override]
        return _commands()

    @commands.setter
    def commands(self, _: MutableMapping[str, Any]) -> None:
        """What a group is made with: none."""


app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, cls=_Group,
                  help="Measure time and error of the solver, and what datasets and plants allow.")


@app.callback()
def _group(context: typer.Context) -> None:
    if context.info_name == OLD_NAME:
        note(f"`vsfsim {OLD_NAME}` is now `vsfsim measure`")
