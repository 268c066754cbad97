"""Methods whose scores are known beforehand, and methods that break the contract one clause at a time."""

import json

import numpy as np

from vsfsim.bench.method import Estimate

ANSWERS = {}
"""The oracle's back door: a test puts noise-free readings here, by the bytes of the poses. No product code knows of
it."""

LOG = []


class Oracle:
    def meta_fit(self, specimens):
        pass

    def adapt(self, view, support):
        LOG.append([reading.action.poses.tobytes() for reading in support])

    def predict(self, touches):
        LOG.append([touch.poses.tobytes() for touch in touches])
        return [ANSWERS[touch.poses.tobytes()] for touch in touches]


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

    def save(self, folder):
        (folder / "constant.json").write_text(json.dumps(self.value))

    def load(self, folder):
        self.value = json.loads((folder / "constant.json").read_text())


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


class Sure(Constant):
    def predict_std(self, touches):
        return [np.full((len(touch.time), touch.size), 2.0) for touch in touches]


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
