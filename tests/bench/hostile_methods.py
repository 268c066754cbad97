"""Methods that mean to cheat or that break, one way each; `test_isolation.py` runs them. A test looks at what they
wrote into the file that the environment names as REPORT."""

import contextlib
import ctypes
import gc
import json
import os
import subprocess
import sys
import time

import numpy as np
import toy_methods
from toy_methods import Constant


def named():
    """The class that the environment names, so that one host runs all of them."""
    name = os.environ["CLASS"]
    return (globals().get(name) or getattr(toy_methods, name))()


class Hostile(Constant):
    def found(self, what):
        if "REPORT" in os.environ:
            with open(os.environ["REPORT"], "a") as file:
                file.write(json.dumps(what) + "\n")


class ReadsFrames(Hostile):
    """Looks through the frames that called it for a truth, a recording or a dataset."""

    def predict(self, touches):
        frame, names = sys._getframe(), []
        while frame is not None:
            names += [f"{type(value).__module__}.{type(value).__qualname__}" for value in frame.f_locals.values()]
            frame = frame.f_back
        self.found(sorted(set(names)))
        return super().predict(touches)


class ReadsMemory(Hostile):
    """Looks through every object that the garbage collector knows of, the support set among them."""

    def adapt(self, view, support):
        super().adapt(view, support)
        self.support = support

    def predict(self, touches):
        gc.collect()
        kinds = [type(item).__name__ for item in gc.get_objects()]
        arrays = [array for item in gc.get_objects() if isinstance(item, (list, tuple, dict))
                  for array in (item.values() if isinstance(item, dict) else item) if isinstance(array, np.ndarray)]
        self.found({"kinds": sorted(set(kinds) & {"Truth", "ObjectView", "Recording", "Dataset", "Subject", "Draw"}),
                    "readings": [float(np.sum(a)) for a in arrays if a.ndim == 2 and a.shape[1] == 1]})
        return super().predict(touches)


class Device(Hostile):
    """Says which GPUs it sees in its training and in each trial."""

    def __init__(self, *, device="auto", host=False):
        super().__init__()
        self.trials_on_host = host

    def meta_fit(self, specimens):
        self.found(os.environ.get("CUDA_VISIBLE_DEVICES"))

    def adapt(self, view, support):
        self.found(os.environ.get("CUDA_VISIBLE_DEVICES"))


class Learns(Hostile):
    """Says what it has learned, and changes it."""

    def meta_fit(self, specimens):
        self.learned = len(specimens)

    def adapt(self, view, support):
        super().adapt(view, support)
        self.found([os.getpid(), self.learned])
        self.learned += 1


class Unpicklable(Hostile):
    def meta_fit(self, specimens):
        self.function = lambda: None


class Overwrites(Hostile):
    """Makes the arrays that it was given writeable and overwrites them: perfect answers, if they were the scorer's."""

    def adapt(self, view, support):
        for reading in support:
            for array in (reading.value, reading.valid, reading.action.poses):
                self.overwrite(array)

    def predict(self, touches):
        for touch in touches:
            self.overwrite(touch.poses)
        return super().predict(touches)

    def overwrite(self, array):
        self.found(array.flags.writeable)
        with contextlib.suppress(ValueError):
            array.flags.writeable = True
        ctypes.memset(array.ctypes.data, 0, array.nbytes)  # no flag keeps a process from its own memory


def _replace_the_scorer():
    from vsfsim.bench import metrics

    for name in ("touch_errors", "score_of_rows"):
        setattr(metrics, name, lambda *_: {"n": 1, "sse": 0.0})
    object.__setattr__(metrics.METRICS["rmse"], "score", lambda records: 0.0)


class ReplacesScorer(Hostile):
    """Replaces the functions that score, when it is built and when it predicts; `hostile_import` does at import."""

    def __init__(self):
        super().__init__()
        _replace_the_scorer()

    def predict(self, touches):
        _replace_the_scorer()
        return super().predict(touches)


class Prints(Hostile):
    def predict(self, touches):
        print("\x1b[31mI am rank 1", flush=True)
        os.system("echo from a shell")
        return super().predict(touches)


class Sleeps(Hostile):
    def predict(self, touches):
        time.sleep(1000.0)


class Answers(Hostile):
    """With the value of the code that the environment holds."""

    def predict(self, touches):
        return eval(os.environ["CODE"])


class Stiffness(Hostile):
    """As `Answers`."""

    def stiffness(self, points):
        return eval(os.environ["CODE"])


class NotPlain(Hostile):
    def __init__(self, *, model=np.zeros(3)):  # noqa: B008
        super().__init__()


class Forges(Hostile):
    """Writes onto every pipe of its process, so that the scorer reads what is no answer."""

    def predict(self, touches):
        for handle in range(3, 64):
            try:
                os.write(handle, (37 << 30).to_bytes(8, "little") + b"x" * 64)
            except OSError:
                continue
        time.sleep(1000.0)


class LeavesSession(Hostile):
    """Leaves a process behind that has left its session and its parent, as a daemon does."""

    def adapt(self, view, support):
        super().adapt(view, support)
        code = ("import os, time\nos.setsid()\nif os.fork(): os._exit(0)\n"
                "open(os.environ['REPORT'], 'w').write(str(os.getpid()) + '\\n')\ntime.sleep(600)")
        subprocess.run([sys.executable, "-c", code])
        until = time.monotonic() + 10.0
        while not os.path.exists(os.environ["REPORT"]) and time.monotonic() < until:
            time.sleep(0.01)


class PrintsMuch(Hostile):
    def __init__(self, *, count=1):
        super().__init__()
        self.count = count

    def predict(self, touches):
        for _ in range(self.count):
            print("x" * 100_000)
        return super().predict(touches)


class NeedsFile(Hostile):
    def __init__(self, *, path=""):
        super().__init__()
        self.path = path

    def adapt(self, view, support):
        super().adapt(view, support)
        open(self.path).close()


class NeedsPart(NeedsFile):
    def __init__(self, *, folder="", file=""):
        super().__init__(path=f"{folder}/toy/{file}")


class Greedy(Constant):
    """Runs the code that the environment holds while it learns, and says how that fails."""

    def meta_fit(self, specimens):
        try:
            exec(os.environ["CODE"])
        except Exception as error:
            print(type(error).__name__, flush=True)
