"""The clock of a frame's limit."""

import time


def now() -> float:
    """Processor time of this process [s], by which the limit of a frame is measured: what else runs on the machine does
    not decide which frames are marked. A thread that waits for the GPU counts, since it waits actively."""
    return time.process_time()
