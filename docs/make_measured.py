"""The tables of figures that the pages include; `docs/make.py` writes them.

Every table comes from the output of a command, which stands above it in the file. `measured/NAME.md` is included by a
page; the README's table stands in it, since GitHub includes nothing. The leaderboards take seconds and a test compares
them with what ships; the others measure, for minutes, on the machine that they name. What another machine measured is
in files that `vsfsim lab tradeoff`, or `vsfsim measure`, wrote there with --json.
"""

import dataclasses
import importlib
import json
import math
import re
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "measured"
sys.path.insert(0, str(ROOT))
NOT = "not measured"
DRAWN = {"foam-block": "accuracy", "shoes-v3-mini": "accuracy-shoe"}
"""Pictures of fronts, by scene."""
BOARDS: dict = {}
"""Leaderboards of the results that ship, by task, each read once."""


def piped(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)) + "\n"


def board_of(task: str) -> Any:
    """The leaderboard of the rows that ship."""
    from papers.results import board_of as read

    return read(task, BOARDS, made=False)


def charts(alone: str = "") -> str:
    """What came out, in one look at each task that ranks a row; of the task ``alone`` a picture of its own."""
    from vsfsim.bench.board.templates import filled
    from vsfsim.bench.leaderboard import chart
    from vsfsim.core.shelf import tasks

    if alone:
        return filled("chart.svg", chart=chart(board_of(alone)), alone=True)
    return "<!-- vsfsim leaderboard --html FILE -->\n" + filled(
        "charts.html", charts=[chart(board_of(task)) for task in tasks()], alone=False)


def leaderboard(task: str, *, short: bool = False) -> str:
    """The table of `vsfsim leaderboard`, without the column of evidence; ``short`` for the README: columns `SHOWN`, and
    the rows of `KINDS` and of ceilings."""
    from vsfsim.bench.leaderboard import CEILING, cells, footnotes, title
    from vsfsim.core.plain_text import markdown as escaped

    board = board_of(task)
    # without what is said of rows that are not ranked and of the column that is not there
    notes = [f"{line[0].upper()}{line[1:]}." for line in footnotes(board, escaped)
             if not line.startswith(("* ", "evidence, ")) and (not short or "unresolved" in line)]
    ceilings = ", ".join(dict.fromkeys(row.result.method for row in board.rows if row.mark == CEILING))
    notes += [f"\\* Not ranked ({ceilings}): {CEILING}."] * bool(ceilings)
    head, rows = cells(board, escaped)
    rows = [row for row in rows if not short or "(" not in row[1] or row[1].startswith(KINDS)]
    kept = [k for k, name in enumerate(head) if (name in SHOWN if short else name != "evidence") and any(
        row[k] for row in rows)]
    return (f"<!-- vsfsim leaderboard --task {task} -->\n{' '.join([f'{title(board.task)}.', *notes])}\n\n"
            + piped([head[k] for k in kept], [[row[k] for k in kept] for row in rows]))


def boards() -> str:
    """The table of every living task that has rows."""
    from vsfsim.core.shelf import tasks

    return "\n".join(f"## `{name}`\n\n{leaderboard(name)}" for name in tasks() if board_of(name).rows)


def studies() -> str:
    """The table of every study that has rows which ship; a star marks a difference of two standard errors."""
    from papers.report import cells, remarks, title
    from papers.results import stored
    from papers.study import load_study
    from papers.study import studies as known

    parts = []
    for one in map(load_study, known()):
        if found := stored(one, BOARDS, made=False):
            head, rows = cells(one, found)
            said = " ".join([title(one, found), one.note, *remarks(found)]).rstrip()
            parts.append(f"## `{one.name}`\n\n{one.title} ({one.source}): {said}\n\n" + piped(head, [
                [cell.replace(" *", " \\*") for cell in row] for row in rows if row[0] in found]))
    return "\n".join(parts) or "No study has rows at this release.\n"


def claims() -> str:
    """The table of `vsfsim papers claims` from the results that ship, and what is different here."""
    from papers.claims import HEAD, HOLDS, RULE, all_verdicts, cells, counts

    found = all_verdicts(boards=BOARDS, made=False)
    numbered = list(enumerate(found, start=1))
    tables = []
    for task in dict.fromkeys(v.task for v in found):
        rows = [[f"**{cell}**" if cell == HOLDS else cell for cell in cells(k, v)]
                for k, v in numbered if v.task == task]
        tables.append(f"## On `{task}`\n\n" + piped(list(HEAD), rows))
    notes = [f"- {k}: {v.claim.note}." for k, v in numbered if v.claim.note]
    return (f"<!-- vsfsim papers claims -->\n{counts(found)} {RULE}\n\n" + "\n".join(tables)
            + "\n## What is different here\n\n" + "\n".join(notes) + "\n")


def audits() -> str:
    """What `vsfsim lab audit` says of each living task that it audits, from the rows and audits that ship."""
    from measurements.audit import KINDS, audit
    from vsfsim.bench.task import load_task
    from vsfsim.core.shelf import tasks

    head = ["task", "rows", "best row", "neighbours that differ", "least difference told",
            *(f"sees only: {kind}" if kind != "constant" else "sees nothing" for kind in KINDS), "over-fit"]
    table = []
    for task in map(load_task, tasks()):
        found = audit(task, [], measure=False)
        shortcut = {s.sees: f"{s.mean:.3f} ± {s.error:.3f}" for s in found.shortcuts}
        pairs, fresh = found.rows - 1, ", ".join(
            f"{value:.2f} ({name.rpartition('-v1-')[2]}, {rows} rows)" for name, rows, value in found.fresh)
        table.append([f"`{task.name}`", str(found.rows), found.best or "none yet",
                      f"{found.told} of {pairs}" if pairs > 0 else NOT, f"{found.least:.3f}" if pairs > 0 else NOT,
                      *(shortcut.get(kind, NOT) for kind in KINDS), fresh or NOT])
    return "<!-- vsfsim lab audit TASK, of each task -->\n" + piped(head, table)


def reality() -> str:
    """The rows of the task of real presses beside those of the same methods on simulated ones like them, and on
    simulated shoes, and how far their orders agree."""
    from scipy.stats import kendalltau

    from vsfsim.bench.leaderboard import labels_of

    names, rows, said = ("real-palpation-v1", "palpation-mini-v1", "fewshot-shoes-v3-mini-v1"), [], []
    for name in names:
        ranked = [row for row in board_of(name).rows if row.rank is not None]
        rows.append({label: (row.rank, row.scores["rmse_ratio"]["5"].mean) for label, row in zip(
            labels_of(ranked), ranked)})
    for name, others in zip(names[1:], rows[1:]):
        both = [label for label in rows[0] if label in others]
        if len(both) < 3:
            said.append(f"Fewer than three of them have rows on `{name}` at this release.")
            continue
        found = kendalltau(*([of[label][1] for label in both] for of in (rows[0], others)))
        said.append(f"With the {len(both)} that `{name}` has, too, Kendall's tau of the errors is "
                    f"{found.statistic:.2f} (p = {found.pvalue:.2g} for no relation).")
    cells = [[label, *(f"{of[label][0]} ({of[label][1]:.3f})" if label in of else NOT for of in rows)]
             for label in rows[0]]
    made = "; ".join(f"vsfsim leaderboard --task {name}" for name in names)
    return (f"<!-- {made} -->\nRank, and error over that of predicting zero after five touches, of the rows of "
            f"`{names[0]}`. {' '.join(said)}\n\n" + piped(["method", *(f"`{name}`" for name in names)], cells))


RESULTS = {one.__name__: one for one in (charts, boards, studies, claims, audits, reality)}
"""Tables of all tasks or studies, by the name of the file."""


def measurement(name: str, **settings: Any) -> str:
    """The tables of `vsfsim measure NAME`."""
    found = importlib.import_module(f"measurements.{name}").measure(progress=print, **settings)
    return written(found, name, settings.get("tier"))


def written(found: Any, name: str, tier: str | None) -> str:
    """The tables of `vsfsim measure NAME`, at one ``tier`` or at all, with the machine, the day and the notes."""
    parts = [f"<!-- vsfsim measure {name}{f' --tier {tier}' if tier else ''}: version {found.version}, commit "
             f"{found.commit} -->\n{found.machine}, {found.date}.\n"]
    for table in (table for table in found.tables if table.rows):
        rows = [[column.cell(row) for column in table.columns] for row in table.rows]
        parts.append(f"{table.title[0].upper()}{table.title[1:]}:\n\n"
                     + piped([column.title() for column in table.columns], rows))
    return "\n".join(parts) + "\n" * bool(found.notes) + "".join(
        f"- {note[0].upper()}{note[1:]}.\n" for note in found.notes)


def recorded(name: str, files: list[Path]) -> str:
    """The table NAME from what commands wrote with --json; the rows of several files, of one machine, stand in one."""
    records = [json.loads(file.read_text()) for file in files]
    if name.startswith("tradeoff-"):
        return tradeoff_table(name.removeprefix("tradeoff-"), MEASURED[name].keywords, records[0])
    module = importlib.import_module(f"measurements.{name}")
    found = module.found_of([row for record in records for row in record[name]], records[0]["settings"])
    of = {key: records[-1][key] for key in ("machine", "version", "commit", "date")}
    return written(dataclasses.replace(found, **of), name, records[0]["settings"].get("tier"))


def tradeoff(scene: str, **options: Any) -> str:
    """The front of `vsfsim lab tradeoff SCENE` in the folder tradeoff/SCENE, and what each goal costs; what is there
    already is not measured again."""
    from measurements.tradeoff import tradeoff as run
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    found = run(load_scene(find_scene(scene)), ROOT / "tradeoff" / scene,
                progress=lambda done, total, what: print(f"{done}/{total} {what}"), **options)
    return tradeoff_table(scene, options, found.table())


def tradeoff_table(scene: str, options: Mapping[str, Any], table: Mapping[str, Any]) -> str:
    """The front of a scene, drawn too, and what each goal costs, from the JSON of `vsfsim lab tradeoff`."""
    from measurements.tradeoff import draw, front
    from vsfsim.data.disk import write_figure

    points = [front.Point(**{**p, "error": math.nan if p["error"] is None else p["error"]}) for p in table["points"]]
    if scene in DRAWN:
        write_figure(draw(points, f"{scene}: {table['what']}"), ROOT / "docs" / "pictures" / f"{DRAWN[scene]}.png")
    head, rows = front.cells(points)
    about = "\n".join(f"- {line[0].upper()}{line[1:]}." for line in (*table["limit"], *table["sentences"]))
    words = scene + "".join(f" --{name} {value}" for name, value in options.items())
    what = f"{table['what'][0].upper()}{table['what'][1:]}, on {table['machine']}"
    return (f"<!-- vsfsim lab tradeoff {words} -->\n{what}:\n\n"
            + piped(head, [[cell.replace("*", "\\*") for cell in row] for row in rows])
            + "\n\\* on the front; = the scene's own setting; x the tier does not show the scene's needs.\n\n"
              f"{about}\n")


MEASURED: dict[str, partial[str]] = {
    **{name: partial(make) for name, make in RESULTS.items()},
    "solver": partial(measurement, "solver"),
    **{f"tradeoff-{scene}": partial(tradeoff, scene) for scene in ("foam-block", "shoes-v3-mini")},
    "tradeoff-shoes-v2-punyo-mini": partial(tradeoff, "shoes-v2-punyo-mini", touches=1),
    "peers": partial(measurement, "peers", tier="fem-coarse", folder=ROOT / "peers")}
"""Table by name of its file."""
SHOWN = ("#", "method", "area", "0-shot", "5-shot")
"""Columns of the README's table."""
KINDS = tuple(f"{name} (tuned)" for name in ("surface-gp", "sbml", "cnp", "near-springs", "imaml", "point-vsf"))
"""Rows of the README's table, one of a kind."""
TABLE = r"<!-- vsfsim leaderboard --task ([\w.-]+) -->"
"""The README's command above its table."""


def readme(text: str) -> str:
    """The README with its table, which stands below the command that prints it."""
    return re.sub(f"{TABLE}.*?(?=<!-- end -->)", lambda mark: leaderboard(mark[1], short=True), text, flags=re.DOTALL)


def write(name: str, files: list[Path]) -> None:
    """Write the table NAME, of ``files`` if there are any."""
    (FOLDER / f"{name}.md").write_text(recorded(name, files) if files else MEASURED[name]())


def write_readme() -> None:
    """Put the table into the README, and draw its chart."""
    text = (ROOT / "README.md").read_text()
    (ROOT / "README.md").write_text(readme(text))
    (FOLDER.parent / "pictures" / "board.svg").write_text(charts(*re.findall(TABLE, text)))
