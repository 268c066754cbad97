"""Writes the tables of figures that the pages include: `python docs/make_measured.py [NAME ...]`.

Every table comes from the output of a command, which stands above it in the file. `measured/NAME.md` is included by a
page; the README's table stands between two marks, since GitHub includes nothing. The leaderboards take seconds and a
test compares them with what ships; the others measure, for minutes, on the machine that they name.
"""

import json
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "measured"
TASKS = ("fewshot-shoes-mini-v1", "fewshot-shoes-graded-mini-v1", "fewshot-shoes-textured-mini-v1",
         "fewshot-shoes-punyo-mini-v1", "fewshot-plants-mini-v2", "inclusion-mini-v2", "localization-mini-v2")


def output(*words: str) -> str:
    """What `vsfsim WORDS` prints, run in the folder of this repository."""
    return subprocess.run([sys.executable, "-c", "from vsfsim.cli.main import main; main()", *words], check=True,
                          capture_output=True, text=True, cwd=ROOT).stdout


def piped(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)) + "\n"


def leaderboard(task: str) -> str:
    """The table of `vsfsim leaderboard`, without the columns that say how a row was made."""
    lines = output("leaderboard", "--task", task, "--markdown", "leaderboard/" + task).splitlines()
    title = next(line for line in lines if "mean ± std" in line)
    title += "".join(f". {line[0].upper()}{line[1:]}." for line in lines if line.startswith("rank corr.: "))
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    table = table[:next((k for k, row in enumerate(table) if row[0] == "method"), len(table))]  # ours, not the papers'
    kept = [k for k, name in enumerate(table[0]) if name not in ("adapt", "vsfsim")
            and any(row[k] for row in table[2:])]
    return (f"<!-- vsfsim leaderboard --task {task} -->\n{title}\n\n"
            + piped([table[0][k] for k in kept], [[row[k] for k in kept] for row in table[2:]]))


def machine() -> str:
    """Where and when figures were measured."""
    cpu = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    return f"{cpu[1] if cpu else platform.machine()}, {date.today().isoformat()}"


def solver() -> str:
    """Error and time of the two reference presses at every tier and precision."""
    rows = json.loads(output("measure", "solver", "--json", "-"))["one_touch"]
    head = ["case", "tier", "precision", "tetrahedra", "unknowns", "force [N]", "error", "CPU s a step", "Newton", "CG",
            "residual", "balance"]
    body = [[r["case"], f"`{r['tier']}`", r["precision"], f"{r['tets']:,}", f"{r['unknowns']:,}", f"{r['force']:.3f}",
             f"{100 * r['error']:+.1f} %", f"{r['step_seconds']:.3f}", f"{r['newton']:.1f}", f"{r['cg']:.1f}",
             f"{r['residual']:.0e}", f"{r['balance']:.0e}"] for r in rows]
    return f"<!-- vsfsim measure solver -->\nOne core of {machine()}.\n\n" + piped(head, body)


MEASURED: dict[str, Callable[[], str]] = {
    **{f"leaderboard-{task}": (lambda task=task: leaderboard(task)) for task in TASKS}, "solver": solver}
"""Table by name of its file."""


def readme(text: str) -> str:
    """The README with its marked table as it is in ``measured/``."""
    return re.sub(r"(<!-- measured: ([\w.-]+) -->\n).*?(<!-- end -->)",
                  lambda m: m[1] + (FOLDER / m[2]).read_text().split("\n", 1)[1] + m[3], text, flags=re.DOTALL)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or MEASURED:
        (FOLDER / f"{name}.md").write_text(MEASURED[name]())
    page = ROOT / "README.md"
    page.write_text(readme(page.read_text()))
