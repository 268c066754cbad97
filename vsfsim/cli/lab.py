"""Groups of commands: `vsfsim lab`, and two that only a checkout has, each in the folder of its name: `vsfsim measure`
in `measurements/`, `vsfsim papers` in `papers/`."""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import MutableMapping
from typing import Any

import typer
from typer.core import TyperGroup

from vsfsim.core.shelf import checkout

OLD = {"bench": "measure", "stability": "measure stability", "study": "papers study", "claims": "papers claims",
       **{name: f"list {name}" for name in ("scenes", "tasks", "methods")},
       "inspect": "show", "view": "show --out page.html", **{name: f"lab {name}" for name in (
           "tradeoff", "export", "import", "score", "new-method", "audit", "seal")}}
"""Commands up to version 0.1, and what they are now."""

FIRST = ("press", "generate", "show", "list", "evaluate", "submit")
"""Commands that `vsfsim --help` shows before the others."""


class WholeSentences(TyperGroup):
    """Click cuts the first sentences of the commands at one line of the terminal; here they go on in the next."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        # up to the first full stop that ends a sentence, on one line
        ends = re.compile(r"(?<=[a-z)`]\.) (?=[A-Z`])")
        rows = [(name, ends.split(" ".join((command.help or "").split("\n\n")[0].split()))[0])
                for name, command in self.commands.items() if not command.hidden]
        for title, first in (("Commands", True), ("More, for authors of methods and tasks", False)):
            if part := [row for row in rows if (ctx.parent is not None or row[0] in FIRST) is first]:
                with formatter.section(title):
                    formatter.write_dl(part)


@functools.cache
def _commands(module: str) -> dict[str, Any]:
    """The commands of the checkout by their names, imported when one is asked for."""
    checkout()
    return dict(typer.main.get_group(importlib.import_module(module).app).commands)


class _Measure(WholeSentences):
    """A group whose commands are those of the checkout."""

    module = "measurements.commands"

    @property
    def commands(self) -> MutableMapping[str, Any]:  # type: ignore[override]
        return _commands(self.module)

    @commands.setter
    def commands(self, _: MutableMapping[str, Any]) -> None:
        """What a group is made with: none."""


class _Papers(_Measure):
    module = "papers.commands"


lab = typer.Typer(no_args_is_help=True, rich_markup_mode=None, cls=WholeSentences,
                  help="Compare simulations, exchange data, and keep methods, tasks and a leaderboard of one's own.")
measure = typer.Typer(no_args_is_help=True, rich_markup_mode=None, cls=_Measure,
                      help="Measure time and error of the solver, and what datasets and plants allow.")
papers = typer.Typer(no_args_is_help=True, rich_markup_mode=None, cls=_Papers,
                     help="Make the papers' tables, and hold their claims against results.")
