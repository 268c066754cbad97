"""A method whose process says that it cannot be forked, as one does that uses a GPU."""

import os

from hostile_methods import Hostile

from vsfsim.bench.isolation import child

child._uses_gpu = lambda: True


class Unforkable(Hostile):
    def meta_fit(self, specimens):
        self.learned = len(specimens)

    def adapt(self, view, support):
        super().adapt(view, support)
        self.found([os.getpid(), self.learned])
        self.learned += 1
