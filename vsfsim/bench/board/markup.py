"""The frame of the leaderboard's pages: plain HTML without fonts or links to other machines, and one short script.

The script sorts a table by the heading that is clicked and filters its rows by the words typed above it. The page's
policy names the script by its digest, so that no other runs, and without it the page is whole.
"""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from vsfsim.core.plain_text import plain

STYLE = """
:root { --ink: #1b1f24; --soft: #59636e; --line: #d8dee4; --back: #ffffff; --band: #f6f8fa; --link: #0b5cad; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6edf3; --soft: #9aa4af; --line: #30363d; --back: #0d1117; --band: #161b22; --link: #6cb2ff; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 92rem; padding: 1.5rem 1rem 4rem; background: var(--back); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0.4rem 0 0.6rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 0.5rem; }
p, li { max-width: 50rem; } a { color: var(--link); } nav { color: var(--soft); font-size: 0.9rem; }
.note, figcaption { color: var(--soft); font-size: 0.88rem; text-align: left; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.7rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { white-space: normal; font-weight: 600; background: var(--band); vertical-align: bottom; }
th.text, td.text { text-align: left; } td.long { white-space: normal; min-width: 16rem; }
figure { margin: 0.6rem 0; } svg { max-width: 100%; height: auto; display: block; }
svg text { font: 12px system-ui, Arial, sans-serif; fill: var(--ink); } svg .soft { fill: var(--soft); }
svg .over { paint-order: stroke; stroke: var(--back); stroke-width: 4px; }
svg .dots { fill: none; stroke-linecap: round; }
svg .truth { stroke: var(--ink); }
svg .axis { stroke: var(--soft); } svg .grid { stroke: var(--line); }
.pair { display: flex; flex-wrap: wrap; gap: 1.2rem; }
th.sortable { cursor: pointer; } th.sortable:hover { color: var(--link); }
input { font: inherit; padding: 0.2rem 0.5rem; margin: 0.3rem 0; color: inherit; background: var(--band);
  border: 1px solid var(--line); }
footer { margin-top: 3rem; border-top: 1px solid var(--line); }
"""
SCRIPT = """
document.querySelectorAll("table").forEach(table => {
  const body = table.tBodies[0], rows = [...body.rows];
  if (rows.length < 2) return;
  [...table.tHead.rows[0].cells].forEach((head, k) => {
    const text = row => row.cells[k].textContent.trim(), value = row => parseFloat(text(row));
    let up = false;
    head.classList.add("sortable");
    head.title = "sort";
    head.addEventListener("click", () => {
      up = !up;
      const words = rows.every(row => isNaN(value(row)));
      const order = (a, b) => words ? text(a).localeCompare(text(b))
        : isNaN(value(a)) ? 1 : isNaN(value(b)) ? -1 : value(a) - value(b);
      [...rows].sort((a, b) => up || (!words && (isNaN(value(a)) || isNaN(value(b)))) ? order(a, b) : order(b, a))
        .forEach(row => body.append(row));
    });
  });
  if (rows.length < 6) return;
  const field = document.createElement("input");
  field.placeholder = "filter";
  field.setAttribute("aria-label", "filter the rows of this table");
  field.addEventListener("input", () => {
    const words = field.value.toLowerCase().split(" ");
    rows.forEach(row => row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word)));
  });
  table.parentElement.before(field);
});
"""
_DIGEST = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()


@dataclass(frozen=True)
class Raw:
    """Text that is HTML already."""

    text: str
    """The HTML."""


Cell = str | Raw


def escape(text: object) -> str:
    """Text of strangers as HTML: no tag, no control character, no reordering of letters."""
    return html.escape(plain(text, longest=2000))


def shown(cell: Cell) -> str:
    """A cell as HTML."""
    return cell.text if isinstance(cell, Raw) else escape(cell)


def link(target: str, text: object) -> Raw:
    """A link to another page of the site."""
    return Raw(f'<a href="{html.escape(target)}">{escape(text)}</a>')


def page(title: str, body: Iterable[str], *, trail: Sequence[Raw] = (), foot: str = "") -> str:
    """A whole page.

    Args:
        title: its heading, plain text. body: HTML, part by part. trail: links to the pages above it. foot: HTML below.
    """
    way = "<nav>" + " / ".join(part.text for part in trail) + "</nav>" if trail else ""
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{_DIGEST}'"
    below = f"\n<footer>{foot}</footer>" if foot else ""
    return ("<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
            f"<meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">\n"
            "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n"
            f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{way}\n"
            f"<h1>{escape(title)}</h1>\n" + "\n".join(body) + f"{below}\n<script>{SCRIPT}</script>\n</body>\n</html>\n")


def table(head: Sequence[str], rows: Sequence[Sequence[Cell]], *, text: Sequence[int] = (0,), long: Sequence[int] = (),
          caption: str = "") -> str:
    """A table.

    Args:
        head: headings. rows: cells. text: numbers of the columns that hold words. long: of those whose words may break.
        caption: below it.
    """
    def kind(k: int) -> str:
        words = [*(["text"] if k in text or k in long else []), *(["long"] if k in long else [])]
        return ' class="' + " ".join(words) + '"' if words else ""

    lines = ["<div class=\"wide\"><table>"]
    lines.append("<thead><tr>" + "".join(f"<th{kind(k)} scope=\"col\">{escape(word)}</th>"
                                         for k, word in enumerate(head)) + "</tr></thead><tbody>")
    lines += ["<tr>" + "".join(f"<td{kind(k)}>{shown(cell)}</td>" for k, cell in enumerate(row)) + "</tr>"
              for row in rows]
    below = [paragraph(caption, note=True)] if caption else []  # no <caption>, which a narrow window would cut
    return "\n".join([*lines, "</tbody></table></div>", *below])


def figure(picture: str, caption: str) -> str:
    """An SVG or image with what it shows."""
    return f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"


def paragraph(text: str, *, note: bool = False) -> str:
    """A paragraph of plain text."""
    return ('<p class="note">' if note else "<p>") + f"{escape(text)}</p>"


def file_name(*words: object) -> str:
    """Name of a page, of letters, digits and dashes."""
    return "-".join(re.sub(r"[^A-Za-z0-9]+", "-", str(word)).strip("-")[:80] or "unnamed" for word in words) + ".html"
