"""The local indentation on bodies that it was not fitted to: `vsfsim measure indentation`.

Balls of 6 to 16 mm are pressed at random places into random blocks of one material, over a stiff ball 0.3 to 3 mm under
the surface, or over a stiff layer, at each tier with and without the compliance. The reference is tier fem on elements
of a fifth of the ball's radius, or of `FINER` of the tier's own where that is less.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import references
import vsfsim
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.stability.team import Ended, answers, kept
from vsfsim.core.errors import VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import Scene, load_scene, parse_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.provenance import commit
from vsfsim.generate.press_result import PressRequest
from vsfsim.generate.presses.probe import prepare
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import body_poses, pose_at, press_path

SCENE = """
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ box = {box} }}
poisson_ratio = {nu}
young_modulus = {{ base = 1e5, inclusions = [{inside}] }}
{resolution}
[probe]
shape = {{ sphere = {radius} }}
[press]
from = {start}
to = {stop}
frames = 5
"""
BODIES = (1, 2, 3, 4, 5, 6)
"""Numbers of random bodies, two of each kind."""
FINER = 0.6
"""Element size of the reference over that of tier fem at most [-]."""
BLOCKS = {"S1": "indent-homogeneous", "S2": "indent"}
"""Scenes of the blocks by the name of their reference, see `references/`; the compliance was fitted to the first."""
COMMAND = "vsfsim measure indentation"
TIERS = ("linear", "fem-coarse", "fem")
REFERENCE = ("the fine mesh", True)
_KINDS = ("one material", "a stiff ball", "a stiff layer")


def scene_of(number: int, *, fine: bool = False) -> Scene:
    """Body ``number``, with the mesh of a press or the fine one."""
    rng = np.random.default_rng(100 + number)
    high = float(rng.uniform(0.02, 0.04))
    box = [*rng.uniform(0.05, 0.08, 2).tolist(), high]
    radius, inside = float(rng.uniform(0.006, 0.016)), ""
    x, y = rng.uniform(-0.01, 0.01, 2).tolist()
    if number % 3 == 1:
        ball, under = float(rng.uniform(0.2, 0.3) * high), float(rng.uniform(0.0003, 0.003))
        aside = rng.uniform(-0.8, 0.8, 2) * ball
        inside = (f"{{ sphere = {[float(v) for v in (x + aside[0], y + aside[1], high - ball - under, ball)]}, "
                  f"value = {float(10 ** rng.uniform(6, 7.5))} }}")
    elif number % 3 == 2:
        thick = float(rng.uniform(0.05, 0.12) * high)
        inside = (f"{{ box = {[-1.0, -1.0, high - 2.0 * thick, 1.0, 1.0, high - thick]}, "
                  f"value = {float(10 ** rng.uniform(5.5, 6.5))} }}")
    nu, depth = float(rng.choice([0.3, 0.45, 0.48])), float(rng.uniform(0.15, 0.3) * radius)
    text = partial(SCENE.format, box=box, nu=nu, inside=inside, radius=radius, start=[x, y, high + radius],
                   stop=[x, y, high + radius - depth])
    scene = parse_scene(text(resolution=""), Path("indentation.toml")).sample(0)
    if not fine:
        return scene
    size = min(radius / 5.0, FINER * tiers.element_size(scene.required_object, "fem", scene.probe))
    return parse_scene(text(resolution=f"resolution = {size}"), Path("indentation.toml")).sample(0)


def push(scene: Scene, tier: str, *, local: bool) -> np.ndarray:
    """Normal force in every frame (5,) [N]."""
    model = prepare(scene, PressRequest(tier=tier)).model
    assert scene.press is not None
    options = dataclasses.replace(tiers.options(tier), local_indentation=local)
    poses = body_poses(scene, press_path(scene.press, scene.probe))
    frames = Solver(model, scene.bodies, options=options, linear=not tiers.TIERS[tier].nonlinear).run(
        poses[:, None], start=body_poses(scene, pose_at(scene.press, scene.probe, 0)[None]))
    return frames.force[:, 0, 2]


def measure(bodies: Sequence[int] = BODIES, file: Path | None = None, *, workers: int = 1,
            progress: Progress = lambda said: None) -> Measurement:
    """Errors of the force at five depths, of these ``bodies``.

    Args:
        bodies: their numbers.
        file: keeps the forces of each press, from which a later run goes on; None for none.
        workers: processes.
        progress: called with a sentence a press.

    Raises:
        VsfsimError: the file was made with another version or commit, or is no such file; a press did not end.
    """
    settings = {"version": vsfsim.__version__, "commit": commit()}
    done = {} if file is None else {_job(row): row for row in kept(file, settings, COMMAND)}
    ways = list(product(TIERS, (True, False)))
    every: list[tuple[int | str, str, bool]] = [(name, *way) for name in BLOCKS for way in ways]
    every += [(body, *way) for body in bodies for way in (REFERENCE, *ways)]
    for job, found in answers([job for job in every if job not in done], _forces, workers=workers, most=3600.0):
        if isinstance(found, Ended):
            raise VsfsimError(f"body {job[0]}, tier {job[1]}: {found.words}. Run it again, with fewer --workers "
                              f"perhaps.")
        done[job] = found
        if file is not None:
            with file.open("a") as out:
                out.write(json.dumps(found) + "\n")
        progress(f"body {job[0]}: {job[1]}")
    return report([done[job] for job in every], settings)


def stored(file: Path) -> Measurement:
    """The report of the presses in a ``file`` of `measure`.

    Raises:
        VsfsimError: it is no such file.
    """
    return report(kept(file, {}, COMMAND), from_json(file.read_text().partition("\n")[0]))


def _job(row: Mapping[str, Any]) -> tuple[int | str, str, bool]:
    return row["body"], row["tier"], row["local"]


def _forces(job: tuple[int | str, str, bool]) -> dict[str, Any]:
    body, tier, local = job
    fine = tier == REFERENCE[0]
    # every tier presses the blocks, whatever they show
    scene = (dataclasses.replace(load_scene(find_scene(BLOCKS[body])).sample(0), needs=()) if isinstance(body, str)
             else scene_of(body, fine=fine))
    return {"body": body, "tier": tier, "local": local,
            "force": push(scene, "fem" if fine else tier, local=local).tolist()}


def report(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """Errors of every press against its body's reference, and their rms by tier."""
    exact = {row["body"]: np.array(row["force"]) for row in rows if row["tier"] == REFERENCE[0]}
    errors, blocks = [], []
    for row in (row for row in rows if row["body"] in BLOCKS):
        known = references.load(row["body"].lower())["force_N"]
        half, full = (row["force"][len(row["force"]) // n - 1] / known[len(known) // n - 1] - 1.0 for n in (2, 1))
        blocks.append({"block": row["body"], "tier": row["tier"], "local": "with" if row["local"] else "without",
                       "half": half, "full": full})
    judged = [row for row in rows if row["body"] in exact and row["tier"] in TIERS]
    for row in sorted(judged, key=lambda row: (row["body"], TIERS.index(row["tier"]), not row["local"])):
        error = np.array(row["force"]) / exact[row["body"]] - 1.0
        errors.append({"body": row["body"], "kind": _KINDS[row["body"] % 3], "tier": row["tier"],
                       "local": "with" if row["local"] else "without", "rms": float(np.sqrt((error**2).mean())),
                       **{f"e{k}": float(e) for k, e in enumerate(error)}})
    means = [{"tier": tier, "local": local, "bodies": len(some),
              "rms": float(np.sqrt(np.mean([row["rms"] ** 2 for row in some]))),
              "last": float(np.mean([row["e4"] for row in some]))}
             for tier, local in product(TIERS, ("with", "without"))
             if (some := [row for row in errors if (row["tier"], row["local"]) == (tier, local)])]
    columns = (Column("body", "body", "1", form="d"), Column("kind", "kind"), Column("tier", "tier"),
               Column("local", "compliance"), *(Column(f"e{k}", f"{20 * (k + 1)} % of the depth", "1", "%", "+.1f")
                                                for k in range(5)), Column("rms", "rms", "1", "%", ".2f"))
    return Measurement.of("indentation", settings, [
        Table("All bodies together", (Column("tier", "tier"), Column("local", "compliance"),
                                      Column("bodies", "bodies", "1", form="d"), Column("rms", "rms", "1", "%", ".2f"),
                                      Column("last", "mean at full depth", "1", "%", "+.1f")), means, "means"),
        Table("Error of the force on the blocks S1, to which the compliance was fitted, and S2, against references/", (
            Column("block", "block"), Column("tier", "tier"), Column("local", "compliance"),
            Column("half", "at 2.5 mm", "1", "%", "+.1f"), Column("full", "at 5 mm", "1", "%", "+.1f")),
            sorted(blocks, key=lambda row: (row["block"], TIERS.index(row["tier"]), row["local"])), "blocks"),
        Table("Error of the force on bodies that the compliance was not fitted to", columns, errors, "errors")],
        notes=[f"the reference of a random body is tier fem on elements of a fifth of the ball's radius, or of "
               f"{FINER:g} of the tier's own"])
