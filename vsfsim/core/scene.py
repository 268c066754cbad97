"""The scene file: what is pressed, by what, along which path, and seen from where.

TOML becomes a frozen dataclass. Any value may be a distribution, ``{ uniform = [a, b] }``,
``{ loguniform = [a, b] }``, ``{ choice = [..] }`` or ``{ each = [..] }``; `SceneFile.sample` fixes them all with one
seed and the object's number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np

from vsfsim.core.bubble import Bubble, parse_sensor, sensor_kind
from vsfsim.core.errors import SceneError
from vsfsim.core.rigid import MAX_BODIES, PressSpec, RigidBody, parse_bodies, parse_press, parse_probe
from vsfsim.core.scene_tables.dataset import ArmSpec, DatasetSpec, TouchSpec, parse_dataset, parse_touches
from vsfsim.core.scene_tables.object import CameraSpec, ObjectSpec, parse_camera, parse_object
from vsfsim.core.shape import MeshFile, Plane, ProbeShape
from vsfsim.core.table import Vector, check_keys, ends, parse_toml, read_text, sample, typed

Need = Literal["normal-force", "bulging", "large-deformation", "appearance", "contact", "coupling"]
NEEDS: tuple[str, ...] = get_args(Need)
"""Words that a scene's ``needs`` may hold."""
Needs = Annotated[tuple[Need, ...], msgspec.Meta(description=f"a list of words from {', '.join(NEEDS)}")]
Allowed = Literal["unused-part", "no-contact", "out-of-reach", "own-weight"]
"""Words that a scene's ``allow`` may hold."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One concrete scene: every distribution is fixed. A scene without an object has a sensor and obstacles."""

    name: str
    """From the file."""
    needs: Needs = ("normal-force",)
    """What the signal depends on, of `NEEDS`."""
    gravity: Vector = (0.0, 0.0, 0.0)
    """Acceleration (3,) [m/s^2]."""
    object: ObjectSpec | None
    """``[object]``, or None without one."""
    probe: ProbeShape
    """What moves along the path."""
    parts: tuple[RigidBody, ...]
    """Bodies that move with the probe."""
    obstacles: tuple[RigidBody, ...]
    """Bodies that stand in the world."""
    press: PressSpec | None
    """``[press]``, or None without one."""
    touches: TouchSpec | None
    """``[touches]``, or None without one."""
    camera: CameraSpec
    """``[camera]``."""
    dataset: DatasetSpec | None
    """``[dataset]``, or None without one."""
    source: Path
    """The file."""
    given: frozenset[str] = frozenset()
    """Tables and keys at the top of the file."""
    sensor: Bubble | None = None
    """An air-filled bubble that moves along the path in the probe's place."""
    arm: ArmSpec | None = None
    """The arm that touches instead of the probe."""
    effector: str = "probe"
    """Name of what touches: "arm" with an [arm], the kind of the [sensor], or else "probe"; one of
    `vsfsim.core.shelf.effectors`."""
    mount_stiffness: float | None = None
    """Stiffness of the spring that carries the probe along its press [N/m]; None for a rigid mount."""
    contact_law: tuple[str, Mapping[str, tuple[float, ...]]] | None = None
    """Name and rows of numbers of the law that ``[probe] law`` gives, see `vsfsim.physics.contact.law`."""
    effector_table: Mapping[str, Any] = field(default_factory=dict)
    """The table of the effector as it is written, e.g. [sensor] or [arm]; an effector that has no parser of its own in
    `vsfsim.core` reads its settings from it."""
    allow: tuple[Allowed, ...] = ()
    """What is meant although it has no effect, of `Allowed`."""

    @property
    def required_sensor(self) -> Bubble:
        """The bubble of ``[sensor]``. Raises a `SceneError` without the table."""
        return self._required(self.sensor, "sensor")

    @property
    def required_object(self) -> ObjectSpec:
        """The body of ``[object]``. Raises a `SceneError` without the table."""
        return self._required(self.object, "object")

    @property
    def presses(self) -> tuple[Scene, ...]:
        """The scene with the probe and the [touches] of each kind of press, its own first (`TouchSpec.kind`).

        Raises:
            SceneError: there is no [touches].
        """
        others = (dataclasses.replace(self, probe=shape or self.probe, touches=spec)
                  for shape, spec in self.required_touches.other)
        return (self, *others)

    @property
    def required_arm(self) -> ArmSpec:
        """The arm of ``[arm]``. Raises a `SceneError` without the table."""
        return self._required(self.arm, "arm")

    @property
    def required_touches(self) -> TouchSpec:
        """The touches of ``[touches]``. Raises a `SceneError` without the table."""
        return self._required(self.touches, "touches")

    def _required(self, found: Any, table: str) -> Any:
        if found is None:
            raise SceneError(f"{self.source}: there is no [{table}]; what was asked for needs one.")
        return found

    @property
    def bodies(self) -> tuple[ProbeShape, ...]:
        """Shapes of all K rigid bodies: the probe, its parts, the obstacles; with a sensor, the obstacles."""
        if self.sensor is not None:
            return tuple(b.shape for b in self.obstacles)
        return (self.probe, *(b.shape for b in (*self.parts, *self.obstacles)))

    @property
    def frictions(self) -> tuple[float, ...]:
        """Coulomb coefficient of each of the K rigid bodies against what they touch, the object or the sensor [-]."""
        if self.sensor is not None:
            return tuple(self.sensor.friction if b.friction is None else b.friction for b in self.obstacles)
        assert self.object is not None
        own = self.object.friction
        return (own, *(own if b.friction is None else b.friction for b in (*self.parts, *self.obstacles)))


@dataclass(frozen=True)
class SceneFile:
    """A scene as written, with its distributions."""

    path: Path
    """The file."""
    text: str
    """Its content, which datasets store."""
    tree: Mapping[str, Any]
    """The parsed TOML."""

    @property
    def name(self) -> str:
        """The scene's name."""
        return str(self.tree.get("name", self.path.stem))

    def sample(self, seed: int | np.random.SeedSequence = 0, *, number: int = 0) -> Scene:
        """Fix every distribution.

        Args:
            seed: an integer >= 0 (0 is valid) or a `SeedSequence`; the same seed gives the same scene.
            number: of the object in its dataset, which chooses the entry of ``each``.

        Raises:
            SceneError: a value out of its range.
        """
        return _build(sample(self.tree, np.random.default_rng(seed), number=number), self.path)

    def varied(self, table: str, **values: Any) -> SceneFile:
        """The same file with other values of a table."""
        return dataclasses.replace(self, tree={**self.tree, table: {**self.tree.get(table, {}), **values}})


def load_scene(path: str | Path) -> SceneFile:
    """Read a scene file and refuse at once what could not be built from it.

    Args:
        path: the TOML file.

    Raises:
        SceneError: not readable, not TOML, an unknown key, or a value (or an end of a distribution) out of range.
        MeshError: a mesh file that it names cannot be read.
    """
    path = Path(path)
    scene = parse_scene(read_text(path, "scene", SceneError), path)
    first = scene.sample(0)
    for shape in (*(() if first.object is None else (first.object.shape,)), *first.bodies):
        if isinstance(shape, MeshFile):
            shape.content()
    return scene


def parse_scene(text: str, path: str | Path) -> SceneFile:
    """Like `load_scene`, from text; ``path`` names it in messages and anchors relative mesh paths."""
    path = Path(path)
    tree = parse_toml(text, path, "scene", SceneError)
    scene = SceneFile(path, text, tree)
    # The ends of every distribution, and each choice, must build: a value out of range is refused before the run.
    for end in ends(tree, str(path)):
        _build(end, path)
    return scene


_KEYS = ("name", "description", "needs", "gravity", "object", "probe", "sensor", "obstacles", "press", "touches",
         "camera", "dataset", "arm", "allow")
_READ: dict[str, Callable[[Any, Path], Any]] = {"object": parse_object, "press": parse_press, "touches": parse_touches,
                                                "dataset": parse_dataset}


def _build(tree: Mapping[str, Any], path: Path) -> Scene:
    check_keys(tree, str(path), _KEYS)
    if "sensor" in tree and "arm" in tree:
        raise SceneError(f"{path}: there is a [sensor] and an [arm]; a dataset is made by a bubble whose mount is led "
                         f"along straight lines, or by an arm without one. Take one of them out.")
    effector = "arm" if "arm" in tree else sensor_kind(tree["sensor"], path) if "sensor" in tree else "probe"
    sensor = parse_sensor(tree["sensor"], path) if effector == "bubble" else None
    if sensor is not None and "probe" in tree:
        raise SceneError(f"{path}: there is a [sensor] and a [probe]; one of them moves along the path. What a bubble "
                         f"is to touch goes into [object] or [[obstacles]].")
    if "object" not in tree and (sensor is None or not tree.get("obstacles")):
        raise SceneError(f"{path}: there is no [object]; a scene needs one, e.g. shape = {{ box = [0.1, 0.1, 0.05] }}"
                         + (", or [[obstacles]] for the [sensor] to press on." if sensor is not None
                            else ", or a [sensor] and [[obstacles]] for it to press on."))
    touches = tree["touches"] if isinstance(tree.get("touches"), Mapping) else {}
    strange = {"level", "other", "late_range", "contact_edge"} if effector != "probe" else set()
    if effector == "arm":  # it draws its own directions
        strange |= {"tilt", "depth_range", "approach_range"}
    for key in (key for key, given in touches.items() if given and key in strange):
        raise SceneError(f"{path} [touches]: {key} is not for a scene that is touched by '{effector}'. Take {key} out.")
    if sensor is not None and "touches" in tree and "object" not in tree:
        raise SceneError(f"{path} [touches]: the touches of a dataset are made on an [object]; this scene has none. "
                         f"Add it, or use [press] on the [[obstacles]].")
    probe, parts, carried = parse_probe(tree.get("probe"), path, touches="touches" in tree)
    if touches.get("contact_edge") is not None and isinstance(probe, Plane):
        raise SceneError(f"{path} [touches]: contact_edge makes elements small in a round contact, which a plane has "
                         f"not. Take it out, or give [object] a finer resolution.")
    obstacles = parse_bodies(tree.get("obstacles", []), path, "obstacles", "pose")
    if (bodies := 1 + len(parts) + len(obstacles)) > MAX_BODIES:
        raise SceneError(f"{path}: probe, parts and obstacles are {bodies} rigid bodies; {MAX_BODIES} are allowed. "
                         f"Join some into one mesh.")
    if "touches" in tree and (parts or obstacles or isinstance(probe, MeshFile)):
        what = "a mesh as its probe" if isinstance(probe, MeshFile) else "[[probe.parts]]" if parts else "[[obstacles]]"
        raise SceneError(f"{path} [touches]: the touches of a dataset are made with one simple probe, which a method "
                         f"can read from it; this scene has {what}. Use it with [press], or take it out.")

    tables: dict[str, Any] = {key: parse(tree[key], path) if key in tree else None for key, parse in _READ.items()}
    return typed(
        tree, Scene, str(path), also=_KEYS, name=str(tree.get("name", path.stem)), probe=probe, parts=parts,
        obstacles=obstacles, camera=parse_camera(tree.get("camera", {}), path), source=path, given=frozenset(tree),
        sensor=sensor, arm=typed(tree["arm"], ArmSpec, f"{path} [arm]") if "arm" in tree else None, effector=effector,
        effector_table=tree.get("arm", tree.get("sensor", tree.get("probe", {}))), **carried, **tables)
