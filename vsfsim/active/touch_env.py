"""`vsfsim/Touch-v0`: choose the touches of an object one by one, so that an estimator predicts the others best.

An episode is one object view of a task's dataset. A step makes one of its stored touches and shows its reading; the
reward is the fall of the estimator's error on the task's query touches, over the error of predicting zero. Nothing is
simulated, so a step takes what `adapt` and `predict` take.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from vsfsim.bench import method as methods
from vsfsim.bench.method import Action, Method, Reading, Specimen
from vsfsim.bench.protocol import Query, divide, folds_of, record, specimen_of
from vsfsim.bench.task import Task, load_task, open_dataset
from vsfsim.core.errors import TaskError
from vsfsim.data.records import View

_FAR = 1e6  # bound of the depths, places and readings of an observation


@dataclass(frozen=True)
class _Object:
    """One object view of the task, without its truth."""

    specimen: Specimen
    view: View
    pool: tuple[Reading, ...]
    plans: tuple[Action, ...]
    places: np.ndarray
    queries: tuple[Query, ...]


class TouchEnv(gymnasium.Env[dict[str, np.ndarray], np.int64]):
    """The environment.

    An action is the number of a touch of the pool, the touches that are no query. An observation has

    - ``rgb`` (H, W, 3) and ``depth`` (H, W) [m], what the camera sees, 0 where it sees nothing;
    - ``places`` (n, 6): of each touch, where its plan ends, world [m], and the unit direction of the press; 0 where an
      object has fewer touches than n;
    - ``made`` (n,): whether a touch was made; also 1 where there is none;
    - ``readings`` (n, T, d) in the task's unit, 0 where a touch was not made or a frame has no reading.

    ``info`` has ``object`` (its name), ``error`` (over that of predicting zero), ``action_mask`` (1 where a touch can
    still be made) and, of an estimator with `predict_std`, ``std`` (n,), the RMS over frames of the standard deviations
    that it gives each touch of the pool, in the task's unit. A touch that was made before is not made again:
    the step is spent and its reward is 0. An episode ends after ``touches`` steps.

    Args:
        task: a task of predicted readings, or its name.
        dataset: folder of its dataset; None for the task's own.
        method: the estimator, a method or its name.
        parameters: of the estimator, if it is a name.
        objects: "test", the test objects of the fold, for an estimator that learned from all its training objects; or
            "train", every second training object, for one that learned from the others.
        fold: of a cross-validated task.
        touches: of an episode.

    Raises:
        TaskError: the task does not rank predicted readings, the dataset is missing, or an argument is not valid.
        MethodError: there is no such method, or it refuses the task.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  Gymnasium's own annotation

    def __init__(self, task: str | Task, *, dataset: str | Path | None = None,
                 method: str | Method = "near-springs", parameters: Mapping[str, Any] | None = None,
                 objects: str = "train", fold: int = 0, touches: int = 5) -> None:
        self.task = load_task(task) if isinstance(task, str) else task
        if self.task.primary not in ("rmse", "rmse_ratio"):
            raise TaskError(f"Touch-v0: task {self.task.name} ranks by {self.task.primary}. The reward is of predicted "
                            f"readings; give a task that ranks by rmse or rmse_ratio.")
        if objects not in ("train", "test") or touches < 1:
            raise TaskError(f"Touch-v0: objects is '{objects}' and touches {touches}; objects is "
                            "train or test, and an episode has at least one touch.")
        opened = open_dataset(self.task, dataset).blind()
        folds = folds_of(opened, self.task.protocol)
        if not 0 <= fold < len(folds):
            raise TaskError(f"Touch-v0: fold is {fold}; task {self.task.name} has {len(folds)}, counted from 0.")
        learned, asked = folds[fold].train, folds[fold].test
        if objects == "train":
            learned, asked = learned[1::2], learned[::2]
        if not learned or not asked:
            raise TaskError(f"Touch-v0: fold {fold} of the dataset in {opened.path} has {len(folds[fold].train)} "
                            f"training objects; the estimator and the episodes need one each.")
        self._objects = [self._read(opened.load(name)) for name in asked]
        self.method = method if not isinstance(method, str) else methods.build_method(
            methods.find_method(method), parameters or {})
        self.method.meta_fit([self._read(opened.load(name)).specimen for name in learned])
        self.touches = touches
        count = max(len(one.pool) for one in self._objects)
        frames = max(len(r.value) for one in self._objects for r in one.pool)
        height, width = self._objects[0].view.depth.shape
        self._shape = (count, frames, self.task.observation.size)
        self.action_space = spaces.Discrete(count)
        self.observation_space = spaces.Dict({  # type: ignore[assignment]  # Gymnasium types it by its values
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0.0, _FAR, (height, width), np.float32),
            "places": spaces.Box(-_FAR, _FAR, (count, 6), np.float32), "made": spaces.MultiBinary(count),
            "readings": spaces.Box(-_FAR, _FAR, self._shape, np.float32)})

    def _read(self, view: Any) -> _Object:
        recording, draw = record(view, self.task), divide(view, self.task.protocol)
        plans = tuple(recording.queries[i].action for i in draw.pool)  # the path taken would tell the reading
        places = np.array([[*plan.poses[np.argmax(plan.poses[:, :3, 3] @ plan.axis), :3, 3],
                            *plan.axis] for plan in plans], np.float32)
        return _Object(specimen_of(view, recording), methods.frozen_view(view.view),
                       tuple(recording.readings[i] for i in draw.pool), plans, places,
                       tuple(recording.queries[i] for i in draw.query))

    def reset(self, *, seed: int | None = None, options: dict[str, Any]
              | None = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin with an object drawn at random, or with ``options={"object": name}``.

        Raises:
            TaskError: there is no such object.
        """
        super().reset(seed=seed)
        names = [one.specimen.name for one in self._objects]
        name = (options or {}).get("object") or names[int(self.np_random.integers(len(names)))]
        if name not in names:
            raise TaskError(f"Touch-v0: there is no object '{name}' in this fold; there are {', '.join(names)}.")
        self._object = self._objects[names.index(name)]
        self._made: list[int] = []
        self._steps, self._error = 0, self._measured()
        return self._shown(), self._info()

    def step(self, action: np.int64) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Make touch ``action``: observation, reward, whether the episode ended, False, and info."""
        self._steps += 1
        before = self._error
        if int(action) not in self._made and int(action) < len(self._object.pool):
            self._made.append(int(action))
            self._error = self._measured()
        ended = self._steps >= self.touches or len(self._made) == len(self._object.pool)
        return self._shown(), before - self._error, ended, False, self._info()

    def _measured(self) -> float:
        """Error on the query touches over that of predicting zero."""
        one, queries = self._object, self._object.queries
        self.method.adapt(one.view, [one.pool[k] for k in self._made])
        actions = [query.action for query in queries]
        found = methods.checked_prediction(self.method.predict(actions), actions,
                                           [f"query {k}" for k in range(len(actions))])
        missed = sum(float(np.sum((p - q.clean)[q.scored] ** 2)) for p, q in zip(found, queries, strict=True))
        whole = sum(float(np.sum(q.clean[q.scored] ** 2)) for q in queries)
        return float(np.sqrt(missed / max(whole, 1e-300)))

    def _left(self) -> np.ndarray:
        """Whether a touch can still be made (n,) int8."""
        left = np.zeros(self._shape[0], np.int8)
        left[:len(self._object.pool)] = 1
        left[self._made] = 0
        return left

    def _shown(self) -> dict[str, np.ndarray]:
        one = self._object
        places = np.zeros((self._shape[0], 6), np.float32)
        places[:len(one.pool)] = one.places
        readings = np.zeros(self._shape, np.float32)
        for k in self._made:
            value = np.where(one.pool[k].valid[:, None], one.pool[k].value, 0.0)
            readings[k, :len(value)] = value
        return {"rgb": np.array(one.view.rgb, np.uint8), "depth": np.array(one.view.depth, np.float32),
                "places": places, "made": 1 - self._left(), "readings": readings}

    def _info(self) -> dict[str, Any]:
        one = self._object
        info: dict[str, Any] = {"object": one.specimen.name, "error": self._error, "action_mask": self._left()}
        if callable(predict_std := getattr(self.method, "predict_std", None)):
            info["std"] = np.zeros(self._shape[0])
            info["std"][:len(one.pool)] = [np.sqrt(np.mean(np.square(std))) for std in predict_std(one.plans)]
        return info
