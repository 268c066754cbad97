"""The chart of one touch as SVG: the true reading, and what a method predicted after some numbers of touches."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping

import numpy as np

from vsfsim.bench.board.charts import COLOURS, round_numbers

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _UP, _DOWN = 300, 170, 44, 8, 8, 26


def touch_chart(time: np.ndarray, truth: np.ndarray, predicted: Mapping[str, np.ndarray], *, band: str,
                unit: str) -> str:
    """Readings over time.

    Args:
        time: of the frames (T,) [s].
        truth: (T,) [unit]; NaN in frames that are not scored.
        predicted: by shot, of R runs (R, T) [unit]; the line is their mean.
        band: the shot whose smallest and largest run are filled.
        unit: of a reading.
    """
    means = {shot: runs.mean(axis=0) for shot, runs in predicted.items()}
    every = np.concatenate([truth[np.isfinite(truth)], *means.values(), predicted[band].min(axis=0),
                            predicted[band].max(axis=0), [0.0]])
    marks = round_numbers(min(float(every.min()), 0.0), float(every.max()))
    low, high = marks[0], marks[-1]
    span = max(float(time[-1] - time[0]), 1e-9)
    across = _LEFT + (_WIDTH - _LEFT - _RIGHT) * (time - time[0]) / span

    def up(values: np.ndarray) -> np.ndarray:
        return _UP + (_HEIGHT - _UP - _DOWN) * (1.0 - (values - low) / (high - low))

    def path(values: np.ndarray) -> str:
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, up(values), strict=True) if np.isfinite(y))

    out = []
    for mark in marks:
        y = float(up(np.array(mark)))
        out.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
                   f'<text x="{_LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{mark:g}</text>')
    least, most = up(predicted[band].min(axis=0)), up(predicted[band].max(axis=0))
    colour = COLOURS[list(predicted).index(band) % len(COLOURS)]
    edge = [*zip(across, least, strict=True), *zip(across[::-1], most[::-1], strict=True)]
    out.append(f'<polygon points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in edge)}" fill="{colour}" opacity="0.18"/>')
    for k, mean in enumerate(means.values()):
        out.append(f'<polyline points="{path(mean)}" fill="none" stroke="{COLOURS[k % len(COLOURS)]}" '
                   f'stroke-width="1.4"/>')
    out.append(f'<polyline class="truth" points="{path(truth)}" fill="none" stroke-width="2.4"/>')
    out.append(f'<text class="soft" x="{_LEFT}" y="{_HEIGHT - 6}">{html.escape(unit)} over {span:.2g} s</text>')
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" role="img">{"".join(out)}</svg>'


def legend(shots: Iterable[str]) -> str:
    """What the lines are, as HTML."""
    names = {"truth": "var(--ink)"}
    names |= {f"{shot}-shot": COLOURS[k % len(COLOURS)] for k, shot in enumerate(shots)}
    return "<p>" + " &emsp; ".join(
        f'<span style="display: inline-block; width: 22px; border-top: 2px solid {colour}; vertical-align: middle">'
        f"</span> {html.escape(name)}" for name, colour in names.items()) + "</p>"
