"""How well do the pressure laws in use describe a sealed bubble? `vsfsim measure pressure-law`.

    sum|f|        SBML eq. 8: dp = sum_i K_i |u_i|, that is the sum of the sizes of the contact forces; its unit is
    taken up by K, so the law has a free scale F_n / A       openvsf: dp = F_n / A_base, the force along the dome's axis
    over the area inside the rim, 7.18e-3 m^2

Both are given the simulator's true contact forces, so what is left is the law's own error and not that of a stiffness
estimate. The truth is the gas:
p V^gamma constant under the membrane's equilibrium, as the dataset stores it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.dense_force import Plan, Progress, Spot, simulate
from vsfsim.core.bubble import Bubble
from vsfsim.core.dome import Dome
from vsfsim.core.errors import DatasetError
from vsfsim.core.shape import Sphere
from vsfsim.data.records import ObjectView, Touch
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.sensing.membrane_fe import SensorError

BASE_AREA = 7.18e-3
"""Area inside the Punyo's rim [m^2]: openvsf's mesh, and pi times 57.25 mm times 40 mm to 0.2 %."""

SEMI_AXIS = Bubble().semi_axes[0]
"""The Punyo's long one [m]."""

CONTACT = 0.05
"""Force [N] from which a frame counts: a third of a real sensor's noise."""

# edges of the bins by distance of the contact's centre from the dome's axis, over the long semi-axis
_RINGS = (0.0, 0.2, 0.4, 1.0)


@dataclass(frozen=True)
class LawReadings:
    """Frames in contact of all touches. All (k,).

    change: of the chamber's pressure (k,) [Pa]. normal: force into the dome along its axis (k,) [N]. summed: sum of the
    sizes of the nodes' forces (k,) [N], NaN if the dataset keeps none. distance: of the centre of the contact from the
    dome's axis (k,) [m], NaN likewise. touch: which one (k,).
    """

    change: np.ndarray
    normal: np.ndarray
    summed: np.ndarray
    distance: np.ndarray
    touch: np.ndarray


@dataclass(frozen=True)
class Law:
    """One law on one set of frames.

    name: of the law. scale: pressure per force it claims [Pa/N]. bias: mean error as it stands over the mean pressure
    change, a fraction. best_scale: the scale that fits these frames best [Pa/N]. scatter: standard deviation of the
    error with the best scale [Pa]; relative: that over the RMS pressure change, a fraction. rms: error as it stands
    [Pa]. frames: how many.
    """

    name: str
    scale: float
    bias: float
    best_scale: float
    scatter: float
    relative: float
    rms: float
    frames: int


def readings(views: Iterable[ObjectView]) -> LawReadings:
    """The frames in contact of all touches of ``views``.

    Raises:
        DatasetError: no touch has a pressure, or no frame is in contact.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    touch_number = seen = 0
    for view in views:
        for touch in view.touches:
            seen += 1
            if touch.pressure is None or touch.rest_pressure is None:
                continue
            parts.append(_of_touch(touch, touch_number))
            touch_number += 1
    if not parts:
        raise DatasetError(f"pressure law: none of {seen} touches has a pressure; the dataset must be made with a "
                           f"bubble, a [sensor] in the scene.")
    out = LawReadings(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if not len(out.change):
        raise DatasetError(f"pressure law: no frame of {touch_number} touches is converged and pushed by more than "
                           f"{CONTACT} N; press deeper.")
    return out


def rim_of_dataset(view: ObjectView) -> tuple[float, float]:
    """Area inside the rim [m^2] and the long semi-axis [m] of the bubble that touched ``view``; a Punyo's where the
    file does not say."""
    if isinstance(view.probe, Dome):
        return view.probe.base_area, float(view.probe.points[:, 0].max())
    return BASE_AREA, SEMI_AXIS


def _of_touch(touch: Touch, number: int) -> tuple[np.ndarray, ...]:
    axis = touch.mount_pose[:, :3, 2]  # out of the dome
    used = touch.converged & (np.linalg.norm(np.nan_to_num(touch.force), axis=1) > CONTACT)
    normal = -np.einsum("ti,ti->t", touch.force, axis)
    summed = distance = np.full(len(used), np.nan)
    if touch.node_force is not None and touch.node_position is not None:
        size = np.linalg.norm(touch.node_force.astype(float), axis=2)
        summed = size.sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = np.einsum("tn,tni->ti", size, touch.node_position.astype(float)) / summed[:, None]
        arm = centre - touch.mount_pose[:, :3, 3]
        distance = np.linalg.norm(arm - np.einsum("ti,ti->t", arm, axis)[:, None] * axis, axis=1)
    return ((touch.pressure - touch.rest_pressure)[used], normal[used], summed[used], distance[used],
            np.full(int(used.sum()), number))


LAW_PRESSES: Plan = (
    (Sphere(0.015), tuple(Spot(f"x {1e3 * x:.0f}, y {1e3 * y:.0f} mm", x, y) for x, y in
                          ((0.0, 0.0), (0.010, 0.0), (0.020, 0.0), (0.030, 0.0), (0.0, 0.010), (0.0, 0.020),
                           (-0.015, 0.015), (-0.030, 0.010)))),
)
"""Presses on a rigid ball, all over one half of the dome, for when there is no dataset."""


def rigid_presses(*, nodes: int | None = None, device: str = "cpu", progress: Progress = lambda _: None) -> LawReadings:
    """Frames in contact of a Punyo pressed on a rigid ball at eight places; ``nodes`` of its mesh, None for the
    default."""
    model = build_bubble(Bubble() if nodes is None else Bubble(nodes=nodes))
    parts = []
    for number, press in enumerate(simulate(model, LAW_PRESSES, device=device, progress=progress)):
        total = press.force.sum(axis=1)
        used = np.linalg.norm(total, axis=1) > CONTACT
        size = np.linalg.norm(press.force[used], axis=2)
        centre = np.einsum("tn,tni->ti", size, press.position[used]) / size.sum(axis=1, keepdims=True)
        parts.append((press.pressure[used] - model.pressure, -total[used, 2], size.sum(axis=1),
                      np.linalg.norm(centre[:, :2], axis=1), np.full(int(used.sum()), number)))
    out = LawReadings(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if not len(out.change):
        raise SensorError(f"pressure law: no press on the mesh of {len(model.mesh.points)} nodes found an equilibrium; "
                          f"take another number of nodes.")
    return out


def law(name: str, force: np.ndarray, change: np.ndarray, *, scale: float | None) -> Law:
    """Score dp = scale * force on frames (k,); ``scale`` [Pa/N] None for the best one.

    The best scale minimises the squared error. Scatter is about that line, so it holds nothing that a calibration could
    take away.
    """
    best = float(force @ change / (force @ force))
    used = best if scale is None else scale
    error, left = used * force - change, best * force - change
    size = float(np.sqrt(np.mean(change**2)))
    return Law(name, used, float(error.mean() / change.mean()), best, float(left.std()), float(left.std() / size),
               float(np.sqrt(np.mean(error**2))), len(change))


def study(found: LawReadings, *, area: float = BASE_AREA, semi_axis: float = SEMI_AXIS) -> dict[str, Any]:
    """All laws on all frames, and by the distance of the contact from the dome's axis.

    Args:
        found: frames. area: A_base [m^2]. semi_axis: the long one [m], which the bins are in.

    Returns:
        "laws": list of `Law` as dictionaries. "rings": list of {"from", "to" [m], "frames", "normal": best Pa/N of F_n,
        "summed": of sum|f|}.
        "frames", "touches": how many. "area".
    """
    laws = [law("F_n / A_base", found.normal, found.change, scale=1.0 / area),
            law("F_n / A fitted", found.normal, found.change, scale=None)]
    rings: list[dict[str, Any]] = []
    if np.isfinite(found.summed).all():
        laws.append(law("sum|f|, scale fitted", found.summed, found.change, scale=None))
        for low, high in pairwise(_RINGS):
            inside = (found.distance >= low * semi_axis) & (found.distance < high * semi_axis)
            if inside.any():
                rings.append({"from": low * semi_axis, "to": high * semi_axis, "frames": int(inside.sum()),
                              "normal": law("", found.normal[inside], found.change[inside], scale=None).best_scale,
                              "summed": law("", found.summed[inside], found.change[inside], scale=None).best_scale})
    return {"laws": [asdict(x) for x in laws], "rings": rings, "frames": len(found.change),
            "touches": len(np.unique(found.touch)), "area": area}


def table(result: dict[str, Any]) -> str:
    """The study as text."""
    out = [f"{result['frames']} frames in contact of {result['touches']} touches; truth: the gas. Bias and RMS of the "
           f"law as it stands; scatter about its best scale:",
           f"{'law':22}{'Pa/N':>8}{'bias':>9}{'RMS Pa':>9}{'best Pa/N':>11}{'scatter Pa':>12}{'of dp':>8}"]
    for x in result["laws"]:
        out.append(f"{x['name']:22}{x['scale']:8.1f}{100 * x['bias']:+8.1f}%{x['rms']:9.1f}{x['best_scale']:11.1f}{x['scatter']:12.1f}{100 * x['relative']:7.1f}%")
    if result["rings"]:
        out += ["", "by the distance of the contact's centre from the dome's axis, Pa for each N:",
                f"{'distance mm':16}{'frames':>7}{'of F_n':>9}{'of sum|f|':>11}"]
        for r in result["rings"]:
            span = f"{1e3 * r['from']:.0f} to {1e3 * r['to']:.0f}"
            out.append(f"{span:16}{r['frames']:7}{r['normal']:9.1f}{r['summed']:11.1f}")
    else:
        out += ["", "The dataset keeps no forces on the sensor's nodes (node_force), so sum|f| and the distance of the "
                    "contact are not known."]
    return "\n".join(out)


def plot(found: LawReadings, result: dict[str, Any], out_png: str | Path) -> None:
    """Each law's pressure against the gas's, coloured by the distance of the contact from the dome's axis."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    laws = result["laws"]
    figure = Figure(figsize=(4.6 * len(laws), 4.2), dpi=100, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    top = 1.05 * float(found.change.max())
    known = np.isfinite(found.distance).all()
    panels = figure.subplots(1, len(laws), squeeze=False)[0]
    for axes, x in zip(panels, laws, strict=True):
        force = found.summed if x["name"].startswith("sum") else found.normal
        shown = axes.scatter(found.change, x["scale"] * force, c=1e3 * found.distance if known else "tab:blue", s=18,
                             cmap="viridis", linewidths=0)
        axes.plot([0, top], [0, top], color="0.4", lw=1)
        axes.set(xlim=(0, top), ylim=(0, max(top, 1.05 * float((x["scale"] * force).max()))),
                 xlabel="pressure change of the gas [Pa]", ylabel="of the law [Pa]")
        axes.set_title(f"{x['name']}: {x['scale']:.0f} Pa/N\nbias {100 * x['bias']:+.1f} %, scatter "
                       f"{100 * x['relative']:.1f} %", fontsize=10)
        axes.grid(color="0.9")
    if known:
        figure.colorbar(shown, ax=panels[-1]).set_label("contact's distance from the axis [mm]", fontsize=9)
    figure.savefig(out_png)
