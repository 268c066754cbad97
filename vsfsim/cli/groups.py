"""A group of commands whose list says of each the whole first sentence of its help."""

from __future__ import annotations

import re
from typing import Any

from typer.core import TyperCommand, TyperGroup


class Sections(TyperCommand):
    """A command whose help has a section for each group of options (typer's ``rich_help_panel``)."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the operands and the options."""
        rows: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            if (row := parameter.get_help_record(ctx)) is not None:
                kind = "Arguments" if parameter.param_type_name == "argument" else "Options"
                rows.setdefault(getattr(parameter, "rich_help_panel", None) or kind, []).append(row)
        for name, own in rows.items():
            with formatter.section(name):
                formatter.write_dl(own)


class WholeSentences(TyperGroup):
    """Click cuts these sentences at one line of the terminal; here they go on in the next."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        # up to the first full stop that ends a sentence, on one line
        ends = re.compile(r"(?<=[a-z)`]\.) (?=[A-Z`])")
        rows = [(name, ends.split(" ".join((command.help or "").split("\n\n")[0].split()))[0])
                for name, command in self.commands.items() if not command.hidden]
        with formatter.section("Commands"):
            formatter.write_dl(rows)
