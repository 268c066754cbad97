"""A group of commands whose list says of each the whole first sentence of its help."""

from __future__ import annotations

import re
from typing import Any

from typer.core import TyperGroup


class WholeSentences(TyperGroup):
    """Click cuts these sentences at one line of the terminal; here they go on in the next."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        rows = [(name, _first_sentence(command.help or "")) for name, command in self.commands.items()
                if not command.hidden]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def _first_sentence(text: str) -> str:
    """Up to the first full stop that ends a sentence, on one line."""
    paragraph = " ".join(text.split("\n\n")[0].split())
    return re.split(r"(?<=[a-z)`]\.) (?=[A-Z`])", paragraph)[0]
