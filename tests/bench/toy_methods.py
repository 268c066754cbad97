"""Methods whose scores are known beforehand, and methods that break the contract one clause at a time."""

import hashlib
import json
from pathlib import Path

import numpy as np

from vsfsim.bench.method import Estimate


def name_of(poses):
    return hashlib.sha256(poses.tobytes()).hexdigest()


class Oracle:
    """The oracle's back door: a test puts noise-free readings into ``folder``/answers.npz, by the hash of the poses,
    and finds in ``folder``/log.jsonl what each trial was given. No product code knows of it."""

    def __init__(self, *, folder=""):
        self.folder = folder
        self.answers = dict(np.load(Path(folder) / "answers.npz")) if folder else {}

    def meta_fit(self, specimens):
        pass

    def adapt(self, view, support):
        self.log([name_of(reading.action.poses) for reading in support])

    def predict(self, touches):
        self.log([name_of(touch.poses) for touch in touches])
        return [self.answers.get(name_of(touch.poses), np.zeros((len(touch.time), touch.size))) for touch in touches]

    def log(self, names):
        if self.folder:
            with open(Path(self.folder) / "log.jsonl", "a") as file:
                file.write(json.dumps(names) + "\n")


class Constant:
    def __init__(self, *, value=1.5):
        self.value = value

    def meta_fit(self, specimens):
        pass

    def adapt(self, view, support):
        self.mean = self.value
        for i, reading in enumerate(support):
            if not np.isfinite(reading.value[reading.valid]).all():
                raise ValueError(f"touch {i} has a reading that is not finite")

    def predict(self, touches):
        return [np.full((len(touch.time), touch.size), self.value) for touch in touches]

    def stiffness(self, points):
        return Estimate(1.0 + points[:, 0] - points[:, 0].min(), np.ones(len(points)))


class Choosy(Oracle):
    """Writes what it is offered, and chooses the last or answers with ``answer``."""

    def __init__(self, *, folder="", answer="last"):
        super().__init__(folder=folder)
        self.answer = answer

    def choose(self, view, so_far, offered):
        self.log([len(so_far), *(name_of(action.poses) for action in offered)])
        return len(offered) - 1 if self.answer == "last" else self.answer


class Seeded(Constant):
    """Its answer is its seed."""

    def __init__(self, *, seed=0):
        super().__init__(value=float(seed))


class Cumulative(Constant):
    def adapt(self, view, support):
        self.value += len(support)


class Random(Constant):
    def predict(self, touches):
        return [np.random.default_rng().normal(size=(len(t.time), t.size)) for t in touches]


class SwallowsNan(Constant):
    def adapt(self, view, support):
        pass


class Flat(Constant):
    """Wrong shape."""

    def predict(self, touches):
        return [np.zeros(len(t.time)) for t in touches]


class Mutates(Constant):
    def meta_fit(self, specimens):
        value = specimens[0].touches[0].value
        value.flags.writeable = True
        value[0] = 7.0


class Negative(Constant):
    def stiffness(self, points):
        return Estimate(-np.ones(len(points)), np.ones(len(points)))


class NegativeStd(Constant):
    def predict_std(self, touches):
        return [np.full((len(touch.time), touch.size), -1.0) for touch in touches]


class AnswersNan(Constant):
    def predict(self, touches):
        out = super().predict(touches)
        out[-1][2] = np.nan
        return out


class Crashes(Constant):
    def adapt(self, view, support):
        raise KeyError("toe")


class NoPredict:
    def meta_fit(self, specimens):
        pass

    def adapt(self, view, support):
        pass


class FoldMean(Constant):
    """Its answer is the mean of all readings that it learned from, plus its seed."""

    def __init__(self, *, seed=0):
        super().__init__()
        self.seed = seed

    def meta_fit(self, specimens):
        readings = np.concatenate([t.value[t.valid].ravel() for s in specimens for t in s.touches])
        self.value = float(np.mean(readings)) + self.seed
