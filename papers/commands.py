"""The commands of `vsfsim papers`: the papers' tables and claims."""

from __future__ import annotations

from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import AtLeastOne, JsonFile, command
from vsfsim.core.errors import TaskError

app = typer.Typer(rich_markup_mode=None)


def _complete(incomplete: str) -> list[str]:
    from papers.study import studies

    return [name for name in studies() if name.startswith(incomplete)]


@command(app)
def study(names: Annotated[list[str] | None, typer.Argument(metavar="NAME", autocompletion=_complete)] = None,
          workers: AtLeastOne = 1, show: bool = False, json: JsonFile = None) -> None:
    """Make a table of the papers: the variants of one evaluation, compared object by object.

    What is there already is kept, and the same command goes on after an interruption. Results go to results/studies.

    Args:
        names: Of a study, or the path of its .toml file; may be given again. Without it, the studies are listed.
        workers: Trainings that run at the same time, of all variants.
        show: Print what is stored and make nothing.
    """
    from papers import report as tables
    from papers.results import make_missing, stored
    from papers.study import load_study, studies
    from vsfsim.bench.commands.catalogue import Catalogue

    known, reasons = [load_study(name) for name in names or []], dict[str, list[str]]()
    if not known:
        listed = {name: load_study(name) for name in studies()}
        found = Catalogue("study", listed, ("study", "task", "title", "source"),
                          [(name, one.task, one.title, one.source) for name, one in listed.items()])
        report(str(found), found.table(), json)
        return
    if not show:
        with Progress("study") as progress:
            for name, message in make_missing(known, workers, progress):
                if message:
                    reasons.setdefault(message.strip(), []).append(name)
                if str(json) != "-":
                    print(f"{name}: {'could not be made' if message else 'made'}", flush=True)
    boards: dict = {}
    pairs = [(one, stored(one, boards)) for one in known]
    numbers = [tables.table(*one) for one in pairs]
    report("\n\n".join(tables.text(*one) for one in pairs), numbers[0] if len(numbers) == 1 else numbers, json)
    if reasons:
        raise TaskError("\n\n".join(f"{'; '.join(which)}: {message}" for message, which in reasons.items()))


@command(app)
def claims(json: JsonFile = None) -> None:
    """Hold the papers' claims against stored results.

    Reads the results that ship, those in results/TASK and those of `vsfsim papers study`. Each verdict names the
    commands behind it.
    """
    from papers import claims as judged
    from papers.study import load_study, studies

    with Progress("claims") as progress:
        verdicts = judged.all_verdicts(progress.over(studies(), load_study))
    report(judged.text(verdicts), judged.table(verdicts), json)
