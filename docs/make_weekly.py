"""The weekly page of stability and speed: `python docs/make_weekly.py FOLDER [--budget 30m] [--kind solid ...]`.

It runs `vsfsim stability` and `vsfsim measure solver --cell small`, keeps their output in FOLDER/DATE-COMMIT and
writes FOLDER/index.md: the tables of this week, and a line a week, so that a change is seen. Run again on the same day
it goes on where it stopped. Times are comparable on the same machine only, which each line names.
"""

import argparse
import datetime
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vsfsim.data.provenance import commit

HEAD = ("date", "vsfsim", "machine", "cells", "converged", "wrong, crashed or over the limit", "solver, 8 cells")


def main() -> None:
    """Run both commands and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--budget", default="30m", help="of vsfsim stability")
    parser.add_argument("--kind", action="append", default=[], help="of vsfsim stability; default: all")
    asked = parser.parse_args()
    code = (commit() or "unknown")[:7]  # cells of two versions are not put together
    today = asked.folder / f"{datetime.date.today().isoformat()}-{code}"
    today.mkdir(parents=True, exist_ok=True)
    kinds = [word for kind in asked.kind for word in ("--kind", kind)]
    said = {"stability": run(today, "stability", "stability", "--out", str(today / "cells"), "--budget", asked.budget,
                             *kinds),
            "solver": run(today, "solver", "measure", "solver", "--cell", "small")}
    (asked.folder / "index.md").write_text(page(said, weeks(asked.folder)), encoding="utf-8")
    print(f"written to {asked.folder / 'index.md'}")


def run(folder: Path, name: str, *words: str) -> str:
    """What a command prints; its numbers go to FOLDER/NAME.json. `stability` ends with 3 where a cell is wrong."""
    out = subprocess.run([sys.executable, "-m", "vsfsim", *words, "--json", str(folder / f"{name}.json")],
                         stdout=subprocess.PIPE, text=True)
    if out.returncode not in (0, 3):
        sys.exit(f"vsfsim {' '.join(words)} ended with {out.returncode}")
    return out.stdout


def weeks(folder: Path) -> list[list[str]]:
    """A row of `HEAD` for each day in the folder that is whole, the newest first."""
    days = sorted((path for path in folder.iterdir() if (path / "solver.json").is_file()
                   and (path / "stability.json").is_file()), reverse=True)
    return [row(path.name[:10], *(json.loads((path / f"{name}.json").read_text()) for name in ("stability", "solver")))
            for path in days]


def row(date: str, stability: Mapping[str, Any], solver: Mapping[str, Any]) -> list[str]:
    """The line of a week, from the records of the two commands."""
    share = stability["shares"][0]
    bad = sum(share.get(name) or 0.0 for name in ("wrong in silence", "crashed", "over the limit"))
    return [date, f"{solver['version']} {solver['commit'][:7]}", solver["machine"], str(share["number"]),
            f"{100 * share['converged']:.1f} %", f"{100 * bad:.1f} %", f"{solver['total'][0]['cpu']:.1f} s"]


def page(said: Mapping[str, str], rows: Sequence[Sequence[str]]) -> str:
    """The page in Markdown."""
    table = ["| " + " | ".join(cells) + " |" for cells in (HEAD, ["---"] * len(HEAD), *rows)]
    parts = [f"## {name.capitalize()}\n\n```text\n{text.rstrip()}\n```\n" for name, text in said.items()]
    return "\n".join(["# Stability and speed, week by week\n", *table, "", *parts])


if __name__ == "__main__":
    main()
