"""What can be won on plants at all: `vsfsim measure plant-ceilings`.

`rod-map` knows the skeleton, displaced by a smooth random field, and the sections, and fits log E of each class of
segments to a few touches by a pattern search: which branch slips off the arm changes with the last bits, so that
differences of neighbouring models are no derivatives. With the true moduli on the displaced skeleton the error is that
of the position alone, and at a nanometre that of the last bits of the geometry; with the plant's own means of the
classes it is that of the classes, too.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import vsfsim
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.stability.team import kept
from vsfsim.bench.protocol import as_planned
from vsfsim.core.plain_text import from_json
from vsfsim.core.plant import Plant
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.provenance import commit
from vsfsim.data.records import Touch
from vsfsim.data.streams import Stream
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.subject import Subject, beams, grow, prepare_job
from vsfsim.generate.plants.touches import finish_touches, solve
from vsfsim.generate.recipe import make_recipe

JITTERS = (0.0, 0.002, 0.005)
"""RMS displacements of the skeleton [m]."""
SHOTS = (5, 10)
"""Touches that the moduli are fitted to."""
REACH = 0.05
"""Over which the displacement is alike [m]."""
COMMAND = "vsfsim measure plant-ceilings"
QUERIES = 15
"""Touches that are predicted, as in the plants' tasks."""
_WAVES = 64  # of the random field
_ROUNDS, _FIRST, _LAST = 4, 1.2, 0.3  # of the search; change of log E that it tries at first, and at last
_FLOOR, _SHARE = 0.3, 0.3  # deviation of a torque [N m], and over its size [-]
_STD = 1.0  # of log E of a class about its mean in the other plants


def measure(*, scene: str = "plants-v4-mini", objects: int | None = None, first: int = 0, touches: int = 26,
            shots: Sequence[int] = SHOTS, jitters: Sequence[float] = JITTERS, seed: int = 0, file: Path | None = None,
            progress: Progress = lambda _: None) -> Measurement:
    """Errors over that of predicting zero, for each plant and displacement of its skeleton.

    Args:
        scene: name or path of a scene with ``[arm]``.
        objects: plants, None for the scene's own number; ``first`` is the number of the first one.
        touches: of each plant, the last `QUERIES` of which are predicted.
        shots: touches that log E of the classes is fitted to.
        jitters: RMS displacements of the skeleton [m].
        seed: of the dataset.
        file: keeps each row, from which a later run goes on, and rows of other plants; None for none.
        progress: called with what is done of each plant.

    Raises:
        VsfsimError: the file was made with another version, commit, scene or seed, or is no such file.
    """
    loaded = load_scene(find_scene(scene))
    settings = {"scene": loaded.name, "seed": seed, "touches": touches, "shots": list(shots)}
    rows = [] if file is None else kept(file, {"version": vsfsim.__version__, "commit": commit(), **settings}, COMMAND)
    recipe = make_recipe(loaded, seed=seed, objects=None, views=1, touches=touches)
    jobs = jobs_of(recipe, loaded.path, Path("."))
    chosen = jobs[first:] if objects is None else jobs[first:first + objects]
    grown = [grow(job.scene(), job.stream(Stream.BODY), number=job.object_index) for job in jobs]
    for job in chosen:
        done = [row["jitter"] for row in rows if row["number"] == job.object_index]
        missing = [jitter for jitter in jitters if jitter not in done]
        if not missing:
            continue
        others = class_means([plant for plant, one in zip(grown, jobs, strict=True) if one is not job])
        for row in of_plant(prepare_job(job, device="cpu"), others, shots, missing,
                            np.random.default_rng((seed, job.object_index)), progress):
            rows.append({"number": job.object_index, **row})
            if file is not None:
                with file.open("a") as out:
                    out.write(json.dumps(rows[-1]) + "\n")
    return report(rows, settings)


def stored(file: Path) -> Measurement:
    """The report of the rows in a ``file`` of `measure`.

    Raises:
        VsfsimError: it is no such file.
    """
    return report(kept(file, {}, COMMAND), from_json(file.read_text().partition("\n")[0]))


def report(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """The rows, plant by plant, and their means over the plants."""
    values = ("true", "own", "prior", *(f"fit{n}" for n in settings["shots"]))
    columns = (Column("plant", "plant"), Column("jitter", "skeleton off by", "m", "mm", ".3g"),
               Column("true", "true moduli", "1", "", ".2f"), Column("own", "own classes", "1", "", ".2f"),
               Column("prior", "rod-map, 0 touches", "1", "", ".2f"),
               *(Column(f"fit{n}", f"{n} touches", "1", "", ".2f") for n in settings["shots"]))
    rows = sorted(rows, key=lambda row: (row["number"], row["jitter"]))
    means = []
    for jitter in sorted({row["jitter"] for row in rows}):
        some = [row for row in rows if row["jitter"] == jitter]
        means.append({"plant": f"mean of {len(some)}", "jitter": jitter,
                      **{key: float(np.mean([row[key] for row in some])) for key in values}})
    return Measurement.of("plant-ceilings", settings, [Table(
        "RMSE of the joint torques over that of predicting zero", columns, [*rows, *means], name="ceilings")],
        notes=[f"the last {QUERIES} of {settings['touches']} touches of each plant of {settings['scene']}, seed "
               f"{settings['seed']}, are predicted along their planned paths, without sensor noise; the field that "
               f"displaces a skeleton is alike over {1e3 * REACH:.0f} mm"])


def of_plant(subject: Subject, others: dict[str, float], shots: Sequence[int], jitters: Sequence[float],
             rng: np.random.Generator, progress: Progress) -> Iterator[dict[str, Any]]:
    """The rows of one plant, one by one.

    Args:
        subject: its true model and its touches. others: mean log E of each class in other plants. shots: numbers of
        touches of the fits. jitters: [m]. rng: of the displacement. progress: called with what is done.
    """
    (made,) = touched([subject])
    known, asked = range(max(shots)), range(len(made) - QUERIES, len(made))
    field = waves(subject.plant.nodes, rng)
    mean = np.array([others.get(name, np.log(1e9)) for name in subject.plant.region_names])
    own = class_means([subject.plant])
    for jitter in jitters:
        moved = displaced(subject.plant, jitter * field)
        row = {"plant": subject.plant.name or subject.job.name, "jitter": jitter,
               "true": error(touched([some(with_plant(subject, moved), asked)])[0], [made[k] for k in asked])}
        thetas = {"own": np.array([own.get(name, 0.0) for name in subject.plant.region_names]), "prior": mean,
                  **{f"fit{n}": fit(some(subject, known[:n]), moved, mean, made[:n]) for n in shots}}
        guesses = [some(with_plant(subject, with_classes(moved, theta)), asked) for theta in thetas.values()]
        for key, found in zip(thetas, touched(guesses), strict=True):
            row[key] = error(found, [made[k] for k in asked])
        progress(f"{row['plant']}, {1e3 * jitter:.0f} mm: " + ", ".join(f"{k} {row[k]:.2f}" for k in ("true", *thetas)))
        yield row


def fit(subject: Subject, plant: Plant, mean: np.ndarray, made: Sequence[Touch]) -> np.ndarray:
    """log E of the classes (R,) of a displaced plant that explains the touches made, of ``subject``'s aims, best of
    what a pattern search tries: all classes together, and each of those that the plant has."""
    theta, length = mean.copy(), _FIRST
    used = np.unique(plant.region[1:])
    ways = [np.ones(len(mean)), *np.eye(len(mean))[used]]
    truth = np.concatenate([np.asarray(one.torque) for one in made])
    good = np.concatenate([as_planned(one) for one in made])
    weight = good[:, None] / (_FLOOR**2 + (_SHARE * np.nan_to_num(truth)) ** 2)

    def losses(tried: Sequence[np.ndarray]) -> np.ndarray:
        found = touched([with_plant(subject, with_classes(plant, one)) for one in tried])
        torque = [np.concatenate([predicted(one, true) for one, true in zip(some, made, strict=True)])
                  for some in found]
        return np.array([(weight * np.nan_to_num(truth - one) ** 2).sum() + ((at - mean)[used] ** 2).sum() / _STD**2
                         for at, one in zip(tried, torque, strict=True)])

    least = losses([theta])[0]
    for _ in range(_ROUNDS):
        tried = [theta + sign * length * way for way in ways for sign in (1.0, -1.0)]
        found = losses(tried)
        if found.min() < least:
            theta, least = tried[int(found.argmin())], found.min()
        else:
            length *= 0.5
        if length < _LAST:
            break
    return theta


def touched(subjects: Sequence[Subject]) -> list[list[Touch]]:
    """The touches of each subject."""
    return [finish_touches(one, solve(one, device="cpu")) for one in subjects]


def predicted(touch: Touch, true: Touch) -> np.ndarray:
    """Joint torques (T, 7) [N m] in the frames of the true touch; a model that stops before them holds its last."""
    assert touch.planned_frame is not None and true.planned_frame is not None
    at = np.flatnonzero(as_planned(touch))
    if not len(at):
        return np.zeros((len(true.planned_frame), 7))
    return np.stack([np.interp(true.planned_frame, touch.planned_frame[at], column)
                     for column in np.asarray(touch.torque)[at].T], axis=1)


def error(found: Sequence[Touch], true: Sequence[Touch]) -> float:
    """RMSE over that of predicting zero, over the frames that were made as planned."""
    good = np.concatenate([as_planned(one) for one in true])
    torque = np.concatenate([np.asarray(one.torque) for one in true])[good]
    off = np.concatenate([predicted(one, other) for one, other in zip(found, true, strict=True)])[good] - torque
    return float(np.sqrt((off**2).sum() / (torque**2).sum()))


def some(subject: Subject, numbers: Sequence[int]) -> Subject:
    """A subject with some of its touches."""
    at = list(numbers)
    return dataclasses.replace(subject, aims=tuple(subject.aims[k] for k in at), poses=subject.poses[:, at])


def with_plant(subject: Subject, plant: Plant) -> Subject:
    """A subject with another plant, touched along the same paths."""
    return dataclasses.replace(subject, plant=plant, model=beams(plant, subject.scene))


def with_classes(plant: Plant, log_modulus: np.ndarray) -> Plant:
    """A plant with log E (R,) of its classes; the cores of its wires change with their segments."""
    modulus = np.exp(np.asarray(log_modulus))[plant.region]
    core = None if plant.yielding is None else plant.yielding * (modulus / plant.young_modulus)[:, None]
    if core is not None:
        core[0] = plant.yielding[0]  # type: ignore[index]
    return dataclasses.replace(plant, young_modulus=modulus, yielding=core)


def class_means(plants: Sequence[Plant]) -> dict[str, float]:
    """Mean log E of the segments of each class over plants that have it."""
    found: dict[str, list[float]] = {}
    for plant in plants:
        for index, name in enumerate(plant.region_names):
            mine = np.flatnonzero(plant.region[1:] == index) + 1
            if len(mine):
                found.setdefault(name, []).append(float(np.log(plant.young_modulus[mine]).mean()))
    return {name: float(np.mean(values)) for name, values in found.items()}


def waves(nodes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A smooth random displacement of nodes (n, 3), RMS length 1, alike over `REACH` (random Fourier features)."""
    number, phase = rng.normal(size=(3, _WAVES)) / REACH, rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    out = np.cos(nodes @ number + phase) @ rng.normal(size=(_WAVES, 3))
    return out / np.sqrt((out**2).sum(axis=1).mean())


def displaced(plant: Plant, way: np.ndarray) -> Plant:
    """A plant whose nodes are displaced by ``way`` (n, 3) [m]; blades stay across their segments. Without a way it is
    the plant to the bit."""
    if not way.any():
        return plant
    nodes = plant.nodes + way
    along = np.zeros_like(nodes)
    along[1:] = nodes[1:] - nodes[plant.parent[1:]]
    along[1:] /= np.linalg.norm(along[1:], axis=1)[:, None]
    normal, blade = plant.blade_normal.copy(), plant.half_width > 0.0
    normal[blade] -= np.einsum("ij,ij->i", normal, along)[blade, None] * along[blade]
    normal[blade] /= np.linalg.norm(normal[blade], axis=1)[:, None]
    return dataclasses.replace(plant, nodes=nodes, blade_normal=normal)
