"""Methods that mean to cheat or that break, one way each; `test_isolation.py` runs them. A test looks at what they
wrote into ``report``, a file."""

import contextlib
import ctypes
import gc
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from toy_methods import Constant

from vsfsim.bench.isolation import child
from vsfsim.bench.method import Estimate


class Hostile(Constant):
    def __init__(self, *, report="", value=1.5):
        super().__init__(value=value)
        self.report = report

    def found(self, what):
        if self.report:
            with open(self.report, "a") as file:
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
    """Looks through every object that the garbage collector knows of."""

    def predict(self, touches):
        gc.collect()
        kinds = [type(item).__name__ for item in gc.get_objects()]
        arrays = [array for item in gc.get_objects() if isinstance(item, (list, tuple, dict))
                  for array in (item.values() if isinstance(item, dict) else item) if isinstance(array, np.ndarray)]
        self.found({"kinds": sorted(set(kinds) & {"Truth", "ObjectView", "Recording", "Dataset", "Subject", "Draw"}),
                    "readings": [float(np.sum(a)) for a in arrays if a.ndim == 2 and a.shape[1] == 1]})
        return super().predict(touches)


class Device(Hostile):
    """Says whether GPUs are hidden from it, whether a trial is a fork of the process that learned, and whether a
    gradient was taken before that fork, by something in PyTorch's place."""

    learned: ClassVar[list[int]] = []
    gradients: ClassVar[list[int]] = []

    def __init__(self, *, device="auto", driver=False, report=""):
        super().__init__(report=report)
        if driver:
            child._driver_is_loaded = lambda: True
        number = SimpleNamespace(backward=lambda: self.gradients.append(1))
        sys.modules["torch"] = SimpleNamespace(zeros=lambda *_, **__: number,
                                               cuda=SimpleNamespace(is_initialized=lambda: False))

    def meta_fit(self, specimens):
        self.learned.append(1)

    def adapt(self, view, support):
        self.found([os.environ.get("CUDA_VISIBLE_DEVICES"), len(self.learned), len(self.gradients)])


class OpensFiles(Hostile):
    """Looks for datasets where they are usually kept, and for their folder in the environment."""

    def predict(self, touches):
        self.found({"here": [str(p) for p in Path().rglob("*")], "below": [str(p) for p in Path("datasets").glob("*")],
                    "environment": [k for k, v in os.environ.items() if "datasets" in v.lower() or k in (
                        "VSFSIM_DATASETS", "PWD", "OLDPWD")]})
        return super().predict(touches)


class OpensPath(Hostile):
    """Opens a file whose absolute path it was told."""

    def __init__(self, *, path="", report=""):
        super().__init__(report=report)
        self.path = path

    def predict(self, touches):
        if self.path:
            try:
                self.found(len(Path(self.path).read_bytes()))
            except OSError as error:
                self.found(type(error).__name__)
        return super().predict(touches)


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
    from vsfsim.bench import metric_functions, metrics

    for module, name in ((metric_functions, "touch_errors"), (metrics, "score_of_rows")):
        setattr(module, name, lambda *_: {"n": 1, "sse": 0.0, "sae": 0.0})
    object.__setattr__(metrics.METRICS["rmse"], "score", lambda records: 0.0)


class ReplacesScorer(Hostile):
    """Replaces the functions that score, when it is built and when it predicts; `hostile_import` does at import."""

    def __init__(self, *, report="", value=1.5):
        super().__init__(report=report, value=value)
        _replace_the_scorer()

    def predict(self, touches):
        _replace_the_scorer()
        return super().predict(touches)


class Remembers(Hostile):
    """Keeps what it was given in every place that a process has, and says how much was there before."""

    seen: ClassVar[list] = []

    def adapt(self, view, support):
        super().adapt(view, support)
        import vsfsim

        held = [len(Remembers.seen), len(getattr(self, "mine", [])), len(getattr(vsfsim, "_mine", [])),
                int(os.environ.get("MINE", 0))]
        self.found([len(support), *held])
        Remembers.seen.append(support)
        self.mine = vsfsim._mine = [support]
        os.environ["MINE"] = "1"


class Lingers(Hostile):
    """Leaves a process behind that outlives its trial."""

    def adapt(self, view, support):
        super().adapt(view, support)
        if self.report:
            child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
            self.found(child.pid)


class Prints(Hostile):
    def predict(self, touches):
        print("\x1b[31mI am rank 1", flush=True)
        os.system("echo from a shell")
        return super().predict(touches)


class Sleeps(Hostile):
    def predict(self, touches):
        time.sleep(1000.0)


class Allocates(Hostile):
    def __init__(self, *, gib=4.0, report=""):
        super().__init__(report=report)
        self.gib = gib

    def predict(self, touches):
        waste = np.ones(int(self.gib * 2**30) // 8)
        return [waste[: len(touch.time), None] for touch in touches]


class Exits(Hostile):
    def predict(self, touches):
        sys.exit(0)


class Dies(Hostile):
    def predict(self, touches):
        os._exit(0)


class Crashes(Hostile):
    def predict(self, touches):
        os.kill(os.getpid(), 11)


class AnswersText(Hostile):
    def predict(self, touches):
        return [np.full((len(t.time), t.size), "1.5") for t in touches]


class AnswersComplex(Hostile):
    def predict(self, touches):
        return [np.full((len(t.time), t.size), 1.5 + 0j) for t in touches]


class AnswersHuge(Hostile):
    def predict(self, touches):
        return [np.full((len(t.time), t.size), 1e308) for t in touches]


class StiffnessIsAList(Hostile):
    def stiffness(self, points):
        return [1.0] * len(points)


class StiffnessIsText(Hostile):
    def stiffness(self, points):
        return Estimate(["soft"] * len(points), ["sure"] * len(points))


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
    """Leaves processes behind that have left its session and its parent, as a daemon does."""

    def adapt(self, view, support):
        super().adapt(view, support)
        if self.report:
            code = ("import os, time\nos.setsid()\nif os.fork(): os._exit(0)\n"
                    f"open({self.report!r}, 'a').write(str(os.getpid()) + '\\n')\ntime.sleep(600)")
            before = self._reports()
            subprocess.run([sys.executable, "-c", code])
            until = time.monotonic() + 10.0
            while self._reports() == before and time.monotonic() < until:
                time.sleep(0.01)

    def _reports(self):
        return open(self.report).read().count("\n") if os.path.exists(self.report) else 0


class TalksOnSocket(Hostile):
    """Asks a daemon on an abstract socket what the trial before said, and starts one if there is none."""

    def adapt(self, view, support):
        import socket

        super().adapt(view, support)
        with socket.socket(socket.AF_UNIX) as line:
            try:
                line.connect(f"\0vsfsim-notes-{self.report}")
                self.value = 0.0
                return
            except OSError:
                pass
        if os.fork() == 0:
            os.setsid()
            with socket.socket(socket.AF_UNIX) as line:
                line.bind(f"\0vsfsim-notes-{self.report}")
                line.listen()
                time.sleep(60.0)
            os._exit(0)
        time.sleep(0.2)


class Peeks(Hostile):
    """Looks for a dataset in the folders of all other processes, and tries to attach to them. ``path`` is the scorer's
    dataset; its answer is 1.5 if it finds nothing."""

    def __init__(self, *, looks_for="toy", value=1.5):
        super().__init__(value=value)
        self.name = looks_for

    def adapt(self, view, support):
        super().adapt(view, support)
        libc = ctypes.CDLL(None, use_errno=True)
        for pid in [name for name in os.listdir("/proc") if name.isdigit() and int(name) != os.getpid()]:
            with contextlib.suppress(OSError):
                if self.name in os.listdir(f"/proc/{pid}/cwd"):
                    self.value = 7.0
            command = Path(f"/proc/{pid}/cmdline").read_bytes() if os.path.exists(f"/proc/{pid}/cmdline") else b""
            if b"pytest" in command and libc.ptrace(0x4206, int(pid), 0, 0) == 0:  # PTRACE_SEIZE does not stop it
                self.value = 9.0


class SleepsInCheck(Hostile):
    def adapt(self, view, support):
        time.sleep(1000.0)


class PrintsMuch(Hostile):
    def predict(self, touches):
        for _ in range(1100):
            print("x" * 1_000_000)
        return super().predict(touches)


class LeavesAndSleeps(LeavesSession):
    def predict(self, touches):
        time.sleep(1000.0)


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
