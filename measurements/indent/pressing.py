"""Presses a case in a peer, whose script gives the press, and keeps a file that is whole after every depth.

    python pressing.py PEER.py CASE.npz OUT.json

It imports numpy alone, since each peer runs in a venv of its own, and lets the script import `references`. The script
has a function

    make(given) -> (version, settings, press)

of the arrays of the case; ``press`` goes from depth to depth [m] and returns the force on the ball [N] and what is
unbalanced over it [-]. In place of these it may return a sentence: why it cannot press the case.
"""

import hashlib
import json
import os
import runpy
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def key_of(given: Mapping[str, np.ndarray], script: str | Path) -> str:
    """A digest of a case and of the script that presses it: a file with the same one need not be made again."""
    out = hashlib.sha256(Path(script).read_bytes())
    for name in sorted(given):
        out.update(name.encode() + np.ascontiguousarray(given[name]).tobytes())
    return out.hexdigest()


def main(script: str, case: str, out: str) -> None:
    """Press along the depths of a case and write after each what there is, so that a run that is stopped leaves it."""
    given = dict(np.load(case))
    sys.path.insert(0, str(Path(__file__).parents[2]))
    peer = runpy.run_path(script)["make"](given)
    if isinstance(peer, str):
        Path(out).write_text(json.dumps({"skipped": peer}))
        return
    version, settings, press = peer
    head = {"key": key_of(given, script), "version": version, "settings": settings, "tets": len(given["tets"])}
    made: dict[str, list[Any]] = {"forces": [], "balance": [], "seconds": []}
    for depth in given["depths"]:
        began = time.process_time()
        force, balance = press(float(depth))
        for name, value in zip(made, (force, balance, time.process_time() - began), strict=True):
            made[name].append(value)
        Path(f"{out}.part").write_text(json.dumps(head | made))
        os.replace(f"{out}.part", out)


if __name__ == "__main__":
    main(*sys.argv[1:])
