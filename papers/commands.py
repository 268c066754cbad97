"""The commands of `vsfsim papers`: the papers' tables and claims."""

from __future__ import annotations

from typing import Annotated

import typer

from vsfsim.cli import cluster
from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import AtLeastOne, JsonFile, command
from vsfsim.core.errors import TaskError

app = typer.Typer(rich_markup_mode=None)


def _complete(incomplete: str) -> list[str]:
    from papers.study import studies

    return [name for name in studies() if name.startswith(incomplete)]


@command(app)
def study(names: Annotated[list[str] | None, typer.Argument(metavar="NAME", autocompletion=_complete)] = None,
          every: Annotated[bool, typer.Option("--all")] = False, workers: AtLeastOne = 1, show: bool = False,
          json: JsonFile = None) -> None:
    """Make a table of the papers: the variants of one evaluation, compared object by object.

    What is there already is kept, and the same command goes on after an interruption. Results go to results/studies.

    Args:
        names: Of a study, or the path of its .toml file; may be given again. Without it, the studies are listed.
        every: All studies that ship.
        workers: Trainings that run at the same time, of all variants.
        show: Print what is stored and make nothing.
    """
    from papers import report as tables
    from papers.results import make_missing, stored
    from papers.study import load_study, studies

    fan = cluster.asked()
    known = [load_study(name) for name in (studies() if every else names or [])]
    if not known:
        listed = [load_study(name) for name in studies()]
        width = 2 + max(len(one.name) for one in listed)
        report("\n".join(f"{one.name:<{width}}{one.title} ({one.source})" for one in listed),
               [{"study": one.name, "title": one.title, "source": one.source, "task": one.task,
                 "variants": [v.name for v in one.variants]} for one in listed], json)
        return
    reasons: dict[str, list[str]] = {}
    if cluster.by_shards(10):
        return
    if not show:
        with Progress("study") as progress:
            for name, message in make_missing(known, workers, progress=progress, fan=fan):
                if message:
                    reasons.setdefault(message.strip(), []).append(name)
                if str(json) != "-":
                    print(f"{name}: {'could not be made' if message else 'made'}", flush=True)
    if fan.shard is not None and not reasons:
        report(f"shard {fan.shard[0]}/{fan.shard[1]}: its trainings are made. When all shards are, the same command "
               f"without a --shard scores them.", {"shard": list(fan.shard)}, json)
        return
    boards: dict = {}
    found = [(one, stored(one, boards)) for one in known]
    numbers = [tables.table(*one) for one in found]
    report("\n\n".join(tables.text(*one) for one in found), numbers[0] if len(numbers) == 1 else numbers, json)
    if reasons:
        raise TaskError("\n\n".join(f"{'; '.join(which)}: {message}" for message, which in reasons.items()))


@command(app)
def claims(json: JsonFile = None) -> None:
    """Hold the papers' claims against stored results.

    Reads the results that ship, those in results/TASK and those of `vsfsim papers study`. Each verdict names the
    commands behind it.
    """
    from papers import claims as judged

    verdicts = judged.all_verdicts()
    report(judged.text(verdicts), judged.table(verdicts), json)
