"""What a scene builds, and nothing else: `vsfsim measure built`.

Each scene is built in a process of its own, so that the modules are those that it imports. Counted are the elements of
its object and of its bubble by kind, the rigid bodies in contact, the pictures that are taken, the arrays of the models
with their bytes, the kernels that its effector launches, and the heavy packages that were imported.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import sparse

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core import shelf
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import Scene, load_scene

HEAVY = ("warp", "torch", "mujoco", "trimesh", "pytetwild", "cholespy", "matplotlib", "PIL", "pyrender", "h5py",
         "sklearn", "numba", "jax", "ray", "rich")
"""Packages whose import costs time or memory that is worth a column."""
_DEEPEST = 6  # levels of records in records that are searched for arrays


def arrays_of(value: Any, deep: int = _DEEPEST, seen: set[int] | None = None) -> Iterator[np.ndarray]:
    """The different arrays of a record, also of those in it."""
    seen = set() if seen is None else seen
    if id(value) in seen or deep < 0:
        return
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        yield value
    elif sparse.issparse(value):
        yield from (part for name in ("data", "indices", "indptr")
                    if isinstance(part := getattr(value, name, None), np.ndarray))
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from arrays_of(inner, deep - 1, seen)
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from arrays_of(inner, deep - 1, seen)
    elif hasattr(value, "__dict__"):
        yield from arrays_of(vars(value), deep - 1, seen)


def built(name: str) -> dict[str, Any]:
    """What the scene called ``name`` builds for its first object, in this process.

    Raises:
        VsfsimError: it cannot be built.
    """
    loaded = load_scene(shelf.find_scene(name))
    scene = loaded.sample(0)
    from vsfsim.generate.effector import effector_of

    effector, models = effector_of(scene), _models(scene)
    tier = effector.check(scene, None) if scene.touches is not None else _press_tier(scene)
    kinds: Counter[str] = Counter()
    for model in models:
        for block in getattr(model, "blocks", ()):
            kinds[block.kind] += len(block.nodes)
    arrays = [a for model in models for a in arrays_of(model)]
    camera = scene.touches is not None and "inside_rgb" in effector.channels(scene)
    pictures = [word for word, on in (("RGB-D", scene.touches is not None), ("inside", camera)) if on]
    kernels = {k.key for k in effector.kernels(scene)}
    return {"scene": name, "effector": scene.effector, "needs": ", ".join(scene.needs) or "-", "tier": tier or "-",
            "elements": ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())) or "-",
            "bodies": {"probe": len(scene.bodies), "sensor": len(scene.obstacles)}.get(effector.table, 0),
            "friction": "yes" if effector.table != "probe" or max(scene.frictions) > 0.0 else "no",
            "pictures": ", ".join(pictures) or "-", "arrays": len(arrays),
            "bytes": float(sum(a.nbytes for a in arrays)),
            "kernels": len(kernels), "modules": " ".join(m for m in HEAVY if m in sys.modules)}


def _models(scene: Scene) -> list[Any]:
    from vsfsim.physics import tiers

    if scene.effector == "arm":
        from vsfsim.generate.plants.admit import grow

        return [grow(scene, np.random.SeedSequence(0))]
    out: list[Any] = []
    if scene.object is not None:
        out.append(tiers.build(scene, str(_press_tier(scene))))
    if scene.effector == "bubble":
        from vsfsim.physics.bubble.sensor import build_bubble

        out.append(build_bubble(scene.required_sensor, where=str(scene.source)))
    return out


def _press_tier(scene: Scene) -> str | None:
    from vsfsim.physics import tiers

    if scene.object is None:
        return None
    if scene.effector == "bubble":
        from vsfsim.generate.effectors.bubble import tier_for

        return tier_for(scene, None)
    return tiers.choose(scene)


def measure(scenes: Sequence[str] = (), *, progress: Progress = lambda said: None) -> Measurement:
    """The table of the scenes, all that ship by default.

    Raises:
        VsfsimError: a scene cannot be built.
    """
    rows, notes = [], []
    for name in scenes or shelf.scenes():
        progress(name)
        words = f"import json; from measurements.built import built; print(json.dumps(built({name!r})))"
        found = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, cwd=shelf.checkout())
        if found.returncode:
            why = found.stderr.strip().splitlines()[-1] if found.stderr.strip() else "its process died"
            if scenes:
                raise VsfsimError(f"{name} cannot be built: {why}")
            notes.append(f"{name} is left out: {why}")
            continue
        rows.append(json.loads(found.stdout.splitlines()[-1]))
    return dataclasses.replace(found_of(rows, {"scenes": list(scenes)}), notes=notes)


def found_of(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """The measurement of these rows."""
    columns = [Column("scene", "scene"), Column("effector", "effector"), Column("tier", "tier"),
               Column("elements", "elements"), Column("pictures", "pictures"), Column("friction", "friction"),
               Column("modules", "packages"), Column("bodies", "rigid bodies", "1", "", "d"),
               Column("arrays", "arrays", "1", "", "d"), Column("bytes", "arrays", "B", "MB", ".1f"),
               Column("kernels", "kernels", "1", "", "d")]
    return Measurement.of("built", settings, [
        Table("What each scene builds for its first object", columns, rows, name="built")])

