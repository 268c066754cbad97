"""Methods on mock objects: their task, objects to learn from, and errors."""

import numpy as np

from vsfsim.bench.check import MOCK_TASK
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record, specimen
from vsfsim.bench.task import parse_task

TASK = parse_task(MOCK_TASK, "mock")


def training(count, **more):
    """The first ``count`` mock objects, as a method learns from them."""
    return [specimen(mock_view(i, split="train", **more), TASK) for i in range(count)]


def error(method, view, support, query):
    """RMS error [N] of what a method answers on the touches ``query`` of a view after those of ``support``."""
    recording = record(view, TASK)
    method.adapt(view.view, [recording.readings[i] for i in support])
    answer = method.predict([recording.readings[i].action for i in query])
    return float(np.sqrt(np.mean([np.mean((a - recording.clean[i]) ** 2) for a, i in zip(answer, query)])))
