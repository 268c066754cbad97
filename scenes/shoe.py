"""A hollow shoe, meshed by construction.

A grid of hexahedra, length x width x height, keeps its outermost layers (the walls) and its lowest layers (the sole).
The cells inside are removed and make the cavity, and a hole in the top layer makes the collar. The grid is then bent
into a shoe: its outer vertices lie on one closed surface, its inner vertices on the same surface offset inwards by the
wall's thickness. That surface is half a ball at the heel, a vault in the middle and half a ball at the toe (the
cube-to-sphere map, with a roundness for each pair of axes), scaled by the width and height of the shoe along its
length.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.hexes import split_hexes
from vsfsim.core.solid import Solid
from vsfsim.scenes._diagonals import improve_rank
from vsfsim.scenes._materials import (
    CLASSES,
    SOLE_MATERIAL,
    TEXTURED,
    MaterialClass,
    draw_appearance,
    draw_modulus,
)
from vsfsim.scenes._shoe_styles import REGIONS, STYLES, ShoeForm, read_parameters

SOLE, TOE_CAP, UPPER, TONGUE, HEEL_COUNTER = range(len(REGIONS))
OUTSOLE = len(REGIONS)
"""Region of the sole's lower layer, where it has one."""
_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))

# Roundness of the grid's edges (0 a square, 1 a circle): of the plan view, of the profiles of heel and toe, and of the
# cross-sections at the collar and over the forefoot.
_PLAN, _HEEL, _TOE, _COLLAR, _FOREFOOT = 0.80, 0.12, 0.72, 0.20, 0.88
# Extents of the regions: along the shoe as fractions of its length, across its top as a fraction of the inner width.
_HEEL_COUNTER_END, _TOE_CAP_START, _TONGUE_LENGTH, _TONGUE_WIDTH = 0.17, 0.80, 0.22, 0.36
_LEAN = 0.10
"""Inward lean of the walls at the collar, as a fraction of the half width."""
LONGEST_CELL = 3.0
"""Largest length of a cell, in units of the wall's thickness. A flat panel of such cells bends within 2 % of plate
theory, and at the coarsest tier no usual wall (5.7 mm and more) is affected. A curved wall needs smaller cells, because
its bending decays over sqrt(radius * wall)."""
_OTHER_PART = 0.2
"""Probability that a part of a shoe with `materials` "any" gets a random class, not the common one."""


def build(parameters: Mapping[str, Any], rng: np.random.Generator, *, resolution: float, where: str) -> Solid:
    """A shoe that stands on z = 0 with its toe towards +x; the origin is below the centre of its bounding box.

    Args:
        parameters: fields of `ShoeForm` and `ShoeOptions`; missing ones are drawn around the style's values.
        rng: random stream of form, moduli and appearance, in this order.
        resolution: size of a cell along the surface [m], limited to 3 walls; walls are one cell thick, the sole one or
            two.
        where: file and section, for error messages.

    Raises:
        SceneError: a parameter is unknown or out of its range, or the resolution is outside 4 to 30 mm.
    """
    if not 0.004 <= resolution <= 0.030:
        raise SceneError(f"{where}: resolution is {resolution!r}; a shoe is meshed with cells of 0.004 to 0.03 m.")
    form, options = read_parameters(parameters, rng, where)
    vertices, hexes, hex_region, rank = mesh(form, min(resolution, LONGEST_CELL * form.wall))
    vertices, tets, owner = divide(form, options.side, vertices, hexes, rank)
    table = TEXTURED if options.materials == "any" else CLASSES
    young_modulus, classes = _moduli(STYLES[options.style].materials if table is CLASSES else None, rng, table=table)
    look = draw_appearance(classes, young_modulus, options.appearance_informative, rng, table=table)
    made_of = ", ".join(f"{region} {material}" for region, material in zip(REGIONS, classes))
    return Solid(vertices, tets, hex_region[owner], REGIONS, young_modulus, look,
                 (f"{options.style}, {options.side}: {made_of}.",))


def divide(form: ShoeForm, side: str, vertices: np.ndarray, hexes: np.ndarray,
           rank: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bend the shoe sideways, centre it and cut its cells.

    Args:
        form: of the shoe.
        side: "left" or "right".
        vertices, hexes, rank: of `mesh`.

    Returns:
        Vertices (n, 3) [m], tetrahedra (m, 4) and the cell of each (m,).
    """
    # Left and right differ only in the bend, because mirroring the grid would invert its cells.
    vertices = vertices.copy()
    vertices[:, 1] += (-1 if side == "left" else 1) * form.bend * _curve(vertices[:, 0] / form.length)
    tets, owner = split_hexes(hexes, improve_rank(vertices, hexes, rank))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices -= [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]]
    return vertices, tets, owner


def _moduli(materials: Mapping[str, tuple[str, ...]] | None, rng: np.random.Generator, *,
            table: Mapping[str, MaterialClass] = CLASSES) -> tuple[np.ndarray, list[str]]:
    """Young's modulus [Pa] and class of ``table`` of every region. Without ``materials`` all parts except the sole are
    of one class, but each gets a random class with probability `_OTHER_PART`."""
    upper = tuple(name for name in table if name != SOLE_MATERIAL)
    most = upper[int(rng.integers(len(upper)))] if not materials else ""
    classes, values = [], []
    for region in REGIONS:
        allowed = materials[region] if materials else upper
        name = allowed[int(rng.integers(len(allowed)))]
        if not materials:
            name = SOLE_MATERIAL if region == "sole" else name if rng.uniform() < _OTHER_PART else most
        classes.append(name)
        values.append(draw_modulus(name, rng, table=table))
    if not materials:
        return np.array(values), classes
    # A toe cap and a heel counter stiffen the upper, so they are at least this much stiffer.
    values[TOE_CAP] = max(values[TOE_CAP], 1.5 * values[UPPER])
    values[HEEL_COUNTER] = max(values[HEEL_COUNTER], 1.2 * values[UPPER])
    return np.array(values), classes


# ---------------------------------------------------------------------------------------------- the grid


def mesh(form: ShoeForm, h: float, *, walls: Mapping[int, float] | None = None,
         outsole: float | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m], hexahedra (c, 8), region of each (c,), and rank of each vertex for `split_hexes` (n,).

    Args:
        form: of the shoe.
        h: size of a cell [m].
        walls: thickness of the regions' walls [m] where it is not the form's.
        outsole: the sole's lowest layer as a part of its thickness [-]: the sole then has two layers, and the lower one
            is the region `OUTSOLE`. None: the sole is one region, in one or two layers.
    """
    nj = 2 * max(2, round((form.width - 2 * form.wall) / h / 2)) + 2
    height = (2 * form.toe_height + form.collar_height + form.throat_height) / 4 - form.sole_fore
    ks = 2 if outsole is not None or 0.5 * (form.sole_heel + form.sole_fore) > 2.2 * h else 1
    nk = max(2, round((height - form.wall) / h)) + 1 + ks
    # Grid planes lie on the borders of the regions, so that meshes of all resolutions have the same regions.
    borders = form.length * np.array([_HEEL_COUNTER_END, form.opening, form.opening + _TONGUE_LENGTH, _TOE_CAP_START])
    marks = [form.wall, *borders, form.length - form.wall]
    counts = [max(1, round((stop - start) / h)) for start, stop in itertools.pairwise(marks)]
    spans = (np.linspace(start, stop, n + 1)[1:] for start, stop, n in zip(marks[:-1], marks[1:], counts))
    along = np.concatenate([[0.0, form.wall], *spans, [form.length]])
    ni = len(along) - 1
    heel, opening, tongue_end, toe = (1 + n for n in np.cumsum(counts)[:4])
    strap = max(1, round(_TONGUE_WIDTH * (nj - 2) / 2))  # half the tongue's width in cells
    tongue = (nj // 2 - strap, nj // 2 + strap)
    cross = np.interp(np.arange(nj + 1), (1, *tongue, nj - 1), (-1.0, -_TONGUE_WIDTH, _TONGUE_WIDTH, 1.0))

    i, j, k = np.indices((ni, nj, nk))
    inside = (i > 0) & (i < ni - 1) & (j > 0) & (j < nj - 1)
    top = k == nk - 1
    cavity = inside & (k >= ks) & ~top
    collar = inside & top & (i < opening)
    region = np.full((ni, nj, nk), UPPER)
    region[(i < heel) & ~top] = HEEL_COUNTER
    region[i >= toe] = TOE_CAP
    region[top & (i >= opening) & (i < tongue_end) & (j >= tongue[0]) & (j < tongue[1])] = TONGUE
    region[k < ks] = SOLE
    if outsole is not None:
        region[k == 0] = OUTSOLE
    wall = np.full((ni + 1, nj + 1, nk + 1), form.wall)
    for part, thickness in (walls or {}).items():
        cells = np.argwhere((region == part) & ~(cavity | collar))
        for corner in _CORNERS:
            wall[tuple((cells + corner).T)] = thickness
    levels = np.linspace(0.0, 1.0, ks + 1) if outsole is None else np.array([0.0, outsole, 1.0])

    keep = ~(cavity | collar)
    index = np.arange((ni + 1) * (nj + 1) * (nk + 1)).reshape(ni + 1, nj + 1, nk + 1)
    hexes = np.stack([index[a:a + ni, b:b + nj, c:c + nk][keep] for a, b, c in _CORNERS], axis=1)
    points = _bend(form, along, cross, nk, wall, levels).reshape(-1, 3)
    used, hexes = np.unique(hexes, return_inverse=True)
    rank = _rank(ni, nj, nk).reshape(-1)[used]
    return points[used], hexes.reshape(-1, 8), region[keep], rank.argsort(kind="stable").argsort(kind="stable")


def _rank(ni: int, nj: int, nk: int) -> np.ndarray:
    """Rank of the vertices: cells are cut from the grid's edges first, where bending flattens a corner, and elsewhere
    into five tetrahedra, mirrored from cell to cell."""
    i, j, k = np.indices((ni + 1, nj + 1, nk + 1))
    outer = ((i == 0) | (i == ni)).astype(int) + ((j == 0) | (j == nj)) + (k == nk)
    inner = ((i == 1) | (i == ni - 1)).astype(int) + ((j == 1) | (j == nj - 1)) + (k == nk - 1)
    edge = (outer >= 2) | ((outer == 0) & (inner >= 2))
    # Where three edges meet, all three outer faces become coplanar, so the cut must start from that corner.
    return np.where(outer == 3, 0, np.where(edge, 1, 2 + (i + j + k) % 2))


# ---------------------------------------------------------------------------------------------- the form


def _bend(form: ShoeForm, along: np.ndarray, cross: np.ndarray, nk: int, wall: np.ndarray,
          levels: np.ndarray) -> np.ndarray:
    """Positions (ni+1, nj+1, nk+1, 3) [m] of the grid's vertices; x from the heel, before the sideways bend.

    ``wall`` (ni+1, nj+1, nk+1) [m] is the wall's thickness at each vertex, ``levels`` (ks+1,) [-] the planes of the
    sole's layers.
    """
    ni, nj, ks = len(along) - 1, len(cross) - 1, len(levels) - 1
    profile = _Profile(form)
    i, j, k = np.indices((ni + 1, nj + 1, nk + 1))
    u = along[i]
    edge = 1.4 * form.wall  # on a rounded corner a step of the grid is 1.4 times as long as the wall is thick
    side = cross[j]
    half = 0.5 * form.width
    v_out = np.where((j == 0) | (j == nj), np.sign(j - nj / 2), side * (1.0 - edge / half))
    rise = np.clip((k - ks) / (nk - 1 - ks), 0.0, 1.0)
    upper = profile.top(u) - profile.sole(u)
    w_out = np.where(k == nk, 1.0, rise * (1.0 - edge / upper))
    outside = (i == 0) | (i == ni) | (j == 0) | (j == nj) | (k == nk)
    # The sole's rim projects below the upper, most at half its height.
    flare = np.where(k < ks, form.flare * np.where((k == 0) & (ks > 1), 0.6, 1.0), 0.0)
    shell = _surface(form, profile, u, v_out, w_out, flare)
    # The sole's inner vertices follow its flare; otherwise the diagonals of its tall outer cells would nearly cross.
    lining = _surface(form, profile, u, side, rise, flare - wall)
    points = np.where(outside[..., None], shell, lining)
    x = points[..., 0]
    below = profile.bottom(x) + (profile.sole(x) - profile.bottom(x)) * levels[np.minimum(k, ks)]
    points[..., 2] = np.where(k < ks, below, points[..., 2])
    points[..., 2] += profile.spring(x)
    return points


def _surface(form: ShoeForm, profile: _Profile, u: np.ndarray, v: np.ndarray, w: np.ndarray,
             grow: np.ndarray) -> np.ndarray:
    """Points (..., 3) [m] of the shoe's outer surface, offset outwards by ``grow`` [m].

    Args:
        u: coordinate along the shoe from the heel [m].
        v: coordinate across the shoe, -1 to 1.
        w: coordinate from the sole up, 0 to 1.
    """
    heel_end, toe_start = 0.55 * form.heel_width, form.length - 0.62 * form.width
    heel_cap, toe_cap = heel_end + grow, form.length - toe_start + grow
    toe = np.clip((u - toe_start) / toe_cap, 0.0, 1.0)
    heel = np.clip((heel_end - u) / heel_cap, 0.0, 1.0)
    end = np.maximum(toe, heel)
    lengthwise = np.where(toe > 0.0, _TOE, _HEEL)
    across = _COLLAR + (_FOREFOOT - _COLLAR) * _step((u / form.length - form.opening + 0.06) / 0.24)
    ee, vv, ww = 0.5 * end**2, 0.5 * v**2, 0.5 * w**2
    fx = np.sqrt(1.0 - _PLAN * vv - lengthwise * ww + _PLAN * lengthwise * vv * ww * 4.0 / 3.0)
    fy = np.sqrt(1.0 - _PLAN * ee - across * ww + _PLAN * across * ee * ww * 4.0 / 3.0)
    fz = np.sqrt(1.0 - lengthwise * ee - across * vv + lengthwise * across * ee * vv * 4.0 / 3.0)
    x = np.where(toe > 0.0, toe_start + toe_cap * toe * fx, np.where(heel > 0.0, heel_end - heel_cap * heel * fx, u))
    lean = 1.0 - _LEAN * w * (1.0 - _step((u / form.length - form.opening) / 0.3))
    y = (profile.half_width(x) + grow) * v * fy * lean
    # An outward offset moves the surface sideways only; an inward one also lowers its top.
    z = profile.sole(x) + (profile.top(x) - profile.sole(x) + np.minimum(grow, 0.0)) * w * fz
    return np.stack([x, y, z], axis=-1)


class _Profile:
    """Half width and heights [m] of a shoe, as smooth functions of the distance x [m] from the heel."""

    def __init__(self, form: ShoeForm):
        heel, ball = 0.5 * form.heel_width, 0.5 * form.width
        waist = 0.94 * 0.5 * (heel + ball)
        toe = form.toe_height
        o = form.opening
        self.half_width = _spline(form.length, ((0.0, heel), (0.16, heel), (0.42, waist), (0.68, ball),
                                                (0.85, 0.97 * ball), (1.0, 0.88 * ball)))
        self.top = _spline(form.length,
                           ((0.0, 1.06 * form.collar_height), (0.06, 1.05 * form.collar_height),
                            (0.20, form.collar_height), (0.5 * (0.2 + o), 0.45 * form.collar_height
                                                         + 0.55 * form.throat_height),
                            (o, form.throat_height),
                            (0.5 * (o + 0.76), 0.5 * form.throat_height + 0.5 * toe + 0.002),
                            (0.76, 1.10 * toe), (0.90, toe), (1.0, 0.92 * toe)))
        self.sole = _spline(form.length, ((0.0, form.sole_heel), (0.25, form.sole_heel),
                                          (0.62, form.sole_fore), (1.0, form.sole_fore)))
        self.bottom = _spline(form.length, ((0.0, 0.0), (0.26, 0.0), (0.36, form.arch),
                                            (0.44, form.arch), (0.56, 0.0), (1.0, 0.0)))
        self.spring = _spline(form.length, ((0.0, 0.0), (0.70, 0.0), (0.85, 0.30 * form.toe_spring),
                                            (1.0, form.toe_spring)))


def _spline(length: float, knots: tuple[tuple[float, float], ...]) -> Callable[[np.ndarray], np.ndarray]:
    """A smooth curve near ``knots`` (fraction of the length, value): the polygon through them, smoothed over a tenth of
    the length."""
    grid = np.linspace(-0.2, 1.2, 1401)
    polygon = np.interp(grid, *np.transpose(knots))
    kernel = np.hanning(103)[1:-1]
    smooth = np.convolve(np.pad(polygon, 50, mode="edge"), kernel / kernel.sum(), mode="valid")
    return lambda x: np.interp(np.asarray(x) / length, grid, smooth)


def _step(t: np.ndarray) -> np.ndarray:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _curve(s: np.ndarray) -> np.ndarray:
    """Sideways offset of the centre line for s in 0..1, in units of the bend: positive at the waist, negative at the
    toe."""
    return np.sin(math.pi * np.clip(s, 0.0, 1.0)) * 0.6 - _step((s - 0.45) / 0.55)
