"""What a method is: a Protocol, the records it receives, and how it is found by name.

A method never receives a truth, nor a reading that it has to predict: an `Action` holds no readings. All arrays that it
receives are read-only.
"""

from __future__ import annotations

import importlib
import inspect
import json
import operator
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.core.extras import MissingPackage
from vsfsim.core.plain_text import plain
from vsfsim.core.shape import ProbeShape
from vsfsim.core.shelf import methods
from vsfsim.data.records import View


@dataclass(frozen=True)
class Action:
    """What the robot does in a touch: all that is known before the touch is made."""

    time: np.ndarray
    """Of each frame (T,) [s]."""
    poses: np.ndarray
    """Probe-to-world transforms (T, 4, 4) [m]; of an arm, those of its tool."""
    axis: np.ndarray
    """Unit press direction, world (3,) [-]."""
    probe: ProbeShape
    """The shape that moves; of an arm, a `vsfsim.core.chain.Chain`."""
    observation: str
    """Name of what will be read: a row of `vsfsim.bench.observations`."""
    size: int
    """Numbers in a reading, d."""
    q: np.ndarray | None = None
    """Joint angles of an arm (T, 7) [rad]; None without an arm."""
    mount_stiffness: float | None = None
    """Of a spring along the press that carries the probe [N/m]: ``poses`` are then those of its mount, and the probe
    gives way by force / stiffness. None for a rigid mount."""


@dataclass(frozen=True)
class Surface:
    """The reconstruction of a deformable sensor's surface in a touch."""

    vertices: np.ndarray
    """Read-out vertices, world (T, N, 3) [m]."""
    force: np.ndarray
    """Contact force of the object on each vertex, world (T, N, 3) [N]; NaN in frames without a reading."""


@dataclass(frozen=True)
class Reading:
    """A touch that was made, and what was read."""

    action: Action
    """What the robot did."""
    value: np.ndarray
    """Readings (T, d) in the task's unit."""
    valid: np.ndarray
    """Whether a frame has a reading (T,) bool. Where it is False the simulator did not converge and the value is
    NaN."""
    surface: Surface | None = None
    """Of a deformable sensor (a bubble); None for a rigid probe."""


@dataclass(frozen=True)
class Specimen:
    """A training object."""

    name: str
    """Of the object view."""
    view: View
    """The RGB-D image."""
    touches: tuple[Reading, ...]
    """All of its touches that have a reading."""


@dataclass(frozen=True)
class Estimate:
    """Stiffness at k points, in the method's own unit: one scale an object is allowed."""

    mean: np.ndarray
    """(k,), >= 0."""
    std: np.ndarray
    """Standard deviations (k,), >= 0."""


@runtime_checkable
class Method(Protocol):
    """An estimator that predicts the readings of touches.

    Optional functions, called after `adapt`:

    - ``stiffness(points (k, 3)) -> Estimate``;
    - ``predict_std(touches) -> standard deviations (T, d) of the readings``, one array a touch;
    - ``choose(view, so_far, offered) -> index into offered``, in a task whose support is chosen: which of the offered
      touches, a sequence of `Action`, to make next. ``so_far`` are the readings of those made, to which the method has
      adapted. The touches are offered in an order drawn for each run;
    - ``locate(vertices (n, 3), triangles (m, 3)) -> object-to-world transform (4, 4)`` of a stiff object of known shape
      (closed meshes that may overlap), hidden in the one that was touched.

    What `meta_fit` learned reaches each trial as a pickled copy of the method. A constructor takes keyword arguments
    only. If one of them is called ``seed``, the method is built and meta-fitted
    anew for every seed of the task.
    """

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Learn from the training objects; called once, before anything else."""

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Adapt to a new object, from its view and 0 or more touches, independently of the object before it."""

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, d) of touches that were not made yet, one array a touch, every frame finite."""


REQUIRED = ("meta_fit", "adapt", "predict")

LARGEST_READING = 1e12
"""A larger predicted reading is refused, in any unit: sums of the squares of millions of them still fit float64."""


def find_method(name: str, *, search: str | None = None) -> type:
    """The class (or factory) of a method. Its module is imported, so its code runs in this process.

    Args:
        name: an installed entry point of the group ``vsfsim.methods``, or ``module:attribute``.
        search: folder in which a module is looked for besides ``sys.path``; default: the working folder.

    Raises:
        MethodError: there is none, it cannot be imported, or it is nothing that can be called.
    """
    if name.partition(":")[0].endswith(".py"):
        file, _, attribute = name.partition(":")
        raise MethodError(f"method '{name}': a method is given as module:attribute, without .py: "
                          f"{Path(file).stem}:{attribute or 'CLASS'}, in the folder of {Path(file).name}.")
    check_name(name)
    module, _, attribute = name.partition(":")
    advice = "Give module:attribute of something importable from here." if attribute else (
        "Install what it needs, or its package again.")
    try:
        if not attribute:
            return methods()[name].load()
        folder = os.getcwd() if search is None else search
        if folder not in sys.path:
            sys.path.insert(0, folder)  # where a method under development is; a console script does not look there
        found = importlib.import_module(module)
        if callable(made := getattr(found, attribute, None)):
            return made
    except MissingPackage:
        raise
    except Exception as error:  # a module may raise anything while it is imported
        raise MethodError(f"method '{name}' cannot be loaded: {type(error).__name__}: {error}. {advice}") from error
    own = [key for key, value in vars(found).items() if getattr(value, "__module__", "") == found.__name__]
    raise MethodError(f"method '{name}': the module {module} ({found.__file__}) has no class '{attribute}'. "
                      f"{did_you_mean(attribute, own)}")


def check_name(name: str) -> None:
    """Refuse a name that is neither installed nor ``module:attribute``, without importing anything.

    Raises:
        MethodError: with the nearest installed name.
    """
    if ":" not in name and name not in methods():
        raise MethodError(f"unknown method '{plain(name)}'. {did_you_mean(name, methods())} `vsfsim list methods` "
                          f"lists them; module:attribute works too.")


def parameters_of(factory: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """All parameters a method will be built with: what was given over the constructor's defaults.

    Raises:
        MethodError: one that the constructor does not take, or one without a value.
    """
    signature = inspect.signature(factory)
    known = {p.name: p for p in signature.parameters.values() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)}
    label = getattr(factory, "__name__", str(factory))
    for key in given:
        if key not in known:
            raise MethodError(f"{label} has no parameter '{key}'. {did_you_mean(key, known)}")
    values = {name: given.get(name, p.default) for name, p in known.items()}
    for name, value in values.items():
        if value is inspect.Parameter.empty:
            raise MethodError(f"{label} needs a value for '{name}'; give --set {name}=VALUE.")
    return values


def plain_parameters(values: Mapping[str, Any]) -> None:
    """Refuse parameters that a result file cannot hold.

    Raises:
        MethodError: with what is no plain value.
    """
    try:
        json.dumps(dict(values), allow_nan=False, ensure_ascii=False).encode()
    except (TypeError, ValueError) as error:
        raise MethodError(f"a parameter cannot be written into a result file: {error}. Use numbers, text, "
                          f"lists.") from error


def build_method(factory: type, parameters: Mapping[str, Any]) -> Method:
    """One instance, checked to have what `Method` asks for.

    Raises:
        MethodError: the constructor refuses, or a required function is missing.
    """
    label = getattr(factory, "__name__", str(factory))
    try:
        method = factory(**parameters)
    except (TypeError, ValueError) as error:
        raise MethodError(f"{label} cannot be built with {dict(parameters)}: {error}") from error
    for name in REQUIRED:
        if not callable(getattr(method, name, None)):
            raise MethodError(f"{label} has no function {name}(); a method needs {', '.join(REQUIRED)}.")
    return method


def checked_prediction(predictions: Any, actions: Sequence[Action], where: Sequence[str]) -> list[np.ndarray]:
    """What `predict` returned, as float64 arrays (T, d).

    Args:
        predictions: the method's answer.
        actions: of the query touches.
        where: name of each touch, for the message.

    Raises:
        MethodError: wrong number, wrong shape, or a number that is not finite; it names the touch.
    """
    try:
        predictions = list(predictions)
    except TypeError:
        raise MethodError(f"predict returned {type(predictions).__name__}; it must return a list with one array (T, "
                          f"d) a touch.") from None
    if len(predictions) != len(actions):
        raise MethodError(f"predict returned {len(predictions)} arrays for {len(actions)} touches; it must return "
                          f"one a touch.")
    out = []
    for prediction, action, name in zip(predictions, actions, where):
        array = _real(prediction, name)
        want = (len(action.time), action.size)
        if array.shape != want:
            raise MethodError(f"prediction for {name} has shape {array.shape}; it must be (T, d) = {want}.")
        wrong = np.argwhere(~(np.abs(array) <= LARGEST_READING))
        if len(wrong):
            raise MethodError(f"prediction for {name} is {array[tuple(wrong[0])]:g} in frame {wrong[0, 0]}; a method "
                              f"must answer with a number everywhere, and no reading is over {LARGEST_READING:g}.")
        out.append(array)
    return out


def checked_choice(index: Any, offered: int) -> int:
    """What `choose` returned, as an index of one of ``offered`` touches.

    Raises:
        MethodError: it is no whole number from 0 to offered - 1.
    """
    try:
        found = operator.index(index)
    except TypeError:
        found = -1
    if isinstance(index, bool) or not 0 <= found < offered:
        raise MethodError(f"choose returned {plain(repr(index), longest=60)}; it must return the index of one of the "
                          f"{offered} offered touches, 0 to {offered - 1}.")
    return found


def _real(prediction: Any, name: str) -> np.ndarray:
    """``prediction`` as float64, if it is made of real numbers."""
    try:
        array = np.asarray(np.ma.filled(prediction, np.nan))  # what is masked is no number
        if array.dtype.kind not in "fiub" and not (array.dtype.kind == "O" and array.size):
            raise TypeError(f"its dtype is {array.dtype}")
        return np.array(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MethodError(f"prediction for {name} is no array of real numbers: {plain(error).rstrip('.')}. Answer "
                          f"with floats, (T, d).") from error


def numbers(value: Any, what: str) -> np.ndarray:
    """``value`` as float64, empty for None.

    Raises:
        MethodError: it is no array of real numbers; ``what`` begins the message.
    """
    try:
        return np.zeros(0) if value is None else np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise MethodError(f"{what} that is not an array of real numbers: {error}.") from error


def check_support(support: Sequence[Reading]) -> None:
    """Refuse touches that no method can learn from.

    Raises:
        MethodError: readings that are not as long as their action says, or one marked valid that is not finite; it
            names the touch.
    """
    for index, reading in enumerate(support):
        if reading.value.shape[1:] != (reading.action.size,):
            raise MethodError(f"touch {index} of the support has readings of {reading.value.shape[1:]} numbers; its "
                              f"action says {reading.action.size}.")
        if not np.isfinite(reading.value[reading.valid]).all():
            raise MethodError(f"touch {index} of the support has a reading that is not finite in a frame "
                              f"marked valid.")


def frozen(array: np.ndarray) -> np.ndarray:
    """A read-only copy, so that a method cannot change what the next one sees."""
    array = np.array(array)
    array.flags.writeable = False
    return array


def frozen_view(view: View) -> View:
    """A view whose arrays are read-only."""
    return View(frozen(view.rgb), frozen(view.depth), frozen(view.mask), frozen(view.intrinsics),
                frozen(view.camera_pose))


