"""Methods whose process says that it cannot be forked, as one does that uses a GPU."""

import os

from hostile_methods import Hostile

from vsfsim.bench.isolation import child


class LearnsOnGpu(Hostile):
    """Uses a GPU to learn, and none after."""

    def meta_fit(self, specimens):
        self.learned = len(specimens)
        child._uses_gpu = lambda: True

    def adapt(self, view, support):
        super().adapt(view, support)
        self.found([os.getpid(), os.getppid(), self.learned])
        self.learned += 1


class Unforkable(LearnsOnGpu):
    def __init__(self, *, report="", value=1.5):
        super().__init__(report=report, value=value)
        child._uses_gpu = lambda: True


class TrialsOnHost(Hostile):
    """Learns on a GPU whose driver is loaded wherever its module is, and needs none for trials if it is told so."""

    def __init__(self, *, device="cuda:0", host=True, report=""):
        super().__init__(report=report)
        child._driver_is_loaded = lambda: True
        self.trials_on_host = host

    def adapt(self, view, support):
        super().adapt(view, support)
        self.found([os.environ.get("CUDA_VISIBLE_DEVICES"), os.getppid()])
