"""Force against depth as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vsfsim.press.bubble import BubblePress
from vsfsim.press.probe import PressResult


def plot(result: PressResult, title: str, path: Path) -> None:
    """Draw the normal force and the support reaction against depth into ``path`` (PNG); frames that failed are crossed
    out."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 4.2), dpi=130)
    depth = 1e3 * result.depth
    force, reaction = np.linalg.norm(result.force, axis=1), np.linalg.norm(result.reaction, axis=1)
    axes.plot(depth, reaction, "-", color="0.75", lw=4, label="reaction of the supports")
    axes.plot(depth, force, "o-", ms=3.5, color="tab:blue", label="force on the probe")
    bad = ~result.converged
    if bad.any():
        axes.plot(depth[bad], force[bad], "x", ms=9, color="tab:red", label="not converged")
    axes.set_xlabel("depth past first contact [mm]")
    axes.set_ylabel("force [N]")
    axes.set_title(f"{title}: tier {result.tier}, {result.tets} tetrahedra", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=9)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def plot_pressure(result: BubblePress, title: str, path: Path) -> None:
    """Draw force and pressure change of a bubble against depth into ``path`` (PNG); frames that failed are crossed
    out."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 4.2), dpi=130)
    depth, force = 1e3 * result.depth, np.linalg.norm(result.force, axis=1)
    axes.plot(depth, force, "o-", ms=3.5, color="tab:blue")
    axes.set_xlabel("depth past first contact [mm]")
    axes.set_ylabel("force [N]", color="tab:blue")
    other = axes.twinx()
    other.plot(depth, result.pressure_change, "s-", ms=3.0, color="tab:orange")
    other.set_ylabel("pressure change [Pa]", color="tab:orange")
    bad = ~result.converged
    axes.plot(depth[bad], force[bad], "x", ms=9, color="tab:red")
    axes.set_title(f"{title}: bubble of {result.nodes} nodes", fontsize=10)
    axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
