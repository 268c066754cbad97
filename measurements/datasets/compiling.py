"""How long the kernels of a scene take to compile from nothing: `vsfsim measure compile`.

Each module is compiled by itself on one thread into an empty folder, for the CPU and for a card. The compiler of a card
comes with Warp and needs no card. `compile_kernels` compiles four modules side by side, so that what a first run waits
for is between the longest module and the sum.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene

SCENES = ("plants-v4-mini", "shoes-v3-mini", "shoes-v2-punyo-mini")
ARCHITECTURE = 90  # of the card, as NVIDIA counts: that of an H100 and an H200


def measure(scenes: Sequence[str] = (), *, card: bool = True, progress: Progress = lambda said: None) -> Measurement:
    """CPU seconds and size of the source of every module of the scenes, `SCENES` by default.

    Args:
        scenes: names or paths.
        card: compile for a card, too.
        progress: called with what is going on.

    Raises:
        VsfsimError: there is no such scene.
    """
    import warp as wp

    from vsfsim.generate.effector import kernels_of
    from vsfsim.physics.runtime import ON_THE_HOST

    rows, sums = [], []
    for name in scenes or SCENES:
        kernels = kernels_of(load_scene(find_scene(name)).sample(0))
        own = []
        for module in {kernel.module.name: kernel.module for kernel in kernels}.values():
            short = module.name.rpartition(".")[2].removeprefix("vsfsim_").split("__")[0]
            progress(f"{name}: {short}")
            row: dict[str, Any] = {"scene": name, "module": short, "lines": 0, "cpu": 0.0, "card": None}
            # Warp warns that code for this CPU may not run on another, which nobody asks of it here
            with tempfile.TemporaryDirectory(prefix="vsfsim-compile-") as folder, wp.ScopedLogLevel(wp.LOG_ERROR):
                began = time.process_time()
                wp.compile_aot_module(module, device="cpu", module_dir=folder)
                row["cpu"] = time.process_time() - began
                row["lines"] = sum(len(source.read_text().splitlines()) for source in Path(folder).glob("*.cpp"))
                if card and module.name not in ON_THE_HOST:
                    began = time.process_time()
                    wp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=folder, use_ptx=False)
                    row["card"] = time.process_time() - began
            own.append(row)
        rows += own
        on_card = [row["card"] for row in own if row["card"] is not None]
        sums.append({"scene": name, "modules": len(own), "lines": sum(row["lines"] for row in own),
                     "cpu": sum(row["cpu"] for row in own), "longest_cpu": max(row["cpu"] for row in own),
                     "card": sum(on_card) if card else None, "longest_card": max(on_card) if on_card else None})
    numbers = [Column("lines", "lines of source", "1", "", "d"), Column("cpu", "for a CPU", "s", "", ".1f"),
               Column("card", "for a card", "s", "", ".1f")]
    return Measurement.of("compile", {"scenes": list(scenes or SCENES), "card": card}, [
        Table("CPU seconds to compile the kernels of a scene, one after the other, with no kernel kept",
              [Column("scene", "scene"), Column("modules", "modules", "1", "", "d"), *numbers[:2],
               Column("longest_cpu", "its longest module", "s", "", ".1f"), numbers[2],
               Column("longest_card", "its longest module", "s", "", ".1f")], sums, name="scenes"),
        Table("Module by module", [Column("scene", "scene"), Column("module", "module"), *numbers], rows,
              name="modules")])
