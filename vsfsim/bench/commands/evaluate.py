"""`vsfsim.evaluate(method, task)` and `vsfsim evaluate`: a score from names."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vsfsim.bench.commands.ceiling import evaluate_ceiling
from vsfsim.bench.commands.own_result import own
from vsfsim.bench.commands.presets import preset as chosen
from vsfsim.bench.commands.side_by_side import Evaluation, gather, make
from vsfsim.bench.evaluate import evaluate as run
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.method import check_name
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task, load_task, open_dataset
from vsfsim.bench.trials import curves
from vsfsim.bench.trials.training import Training
from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import ceilings
from vsfsim.data.dataset import Dataset


def evaluate(method: str | type, task: str | Path | Task, dataset: str | Path | Dataset | None = None, *,
             parameters: Mapping[str, Any] | None = None, seeds: int | None = None, workers: int = 1,
             timeout: float | None = None, memory: float | None = None, sandbox: str = "",
             out: str | Path | None = None, preset: str = "", processes: int = 1, keep: str = "",
             on: str = "test", progress: Callable[[int, int, str], None] | None = None) -> Result:
    """Score a method on a task; `vsfsim.evaluate` is this function.

    Args:
        method: name of an installed method, module:attribute, or a class of an importable module. It runs in a process
            of its own. "resim" and "fem-map" are ceilings (`vsfsim.bench.commands.ceiling`).
        task: name of a shipped task, path of a .toml file, or a loaded task.
        dataset: its folder; None for the task's, under datasets/ or $VSFSIM_DATASETS.
        parameters: of the method's constructor, over its defaults.
        seeds: draws of the support set, None for the task's own number.
        workers: trials that run at the same time.
        timeout: seconds that one call of the method may take, None for no limit.
        memory: memory that a process of the method may allocate [GiB], None for no limit.
        sandbox: "bubblewrap" or "namespaces", which hide files and network, or "process"; "" for the strongest one that
        works here.
        out: result file to write, or None; `vsfsim leaderboard` reads it. Finished seeds are kept beside it until all
            are done, and what the method prints goes to a file beside it, RESULT.json.log.
        preset: "paper" or "tuned", settings of a method that ships; ``parameters`` go over them. "" for none.
        processes: trainings that run at the same time, each in a process of its own.
        keep: "predictions" writes every prediction beside the truth, RESULT.predictions.npz, which `vsfsim inspect`
        draws; "" writes none.
        on: "test"; "development" for the objects on which settings are made; or "seed-N" for others of seed N. Such a
        result is of TASK-development or TASK-seed-N (`Task.on`).
        progress: called with (trials done, of how many, what is going on).

    Raises:
        VsfsimError: the method, the task or the dataset is unknown or does not fit, or the method raised.
    """
    name = method if isinstance(method, str) else name_of(method)
    if name not in ceilings():
        check_name(name)
    if keep not in ("", "predictions") or (keep and out is None):
        raise MethodError(f"keep is '{keep}' and out is {out}; keep is '' or 'predictions', which are written beside "
                          f"the result file of out.")
    wanted = (task if isinstance(task, Task) else load_task(task)).on(on)
    data = open_dataset(wanted, dataset.path if isinstance(dataset, Dataset) else dataset)
    if name in ceilings():
        return evaluate_ceiling(name, wanted, data, parameters=parameters, processes=processes, progress=progress,
                                out=None if out is None else Path(out), keep=keep)
    isolation = Isolation(sandbox, timeout, memory, workers)
    if preset:
        parameters = {**chosen(name, preset, wanted.observation.name, wanted.metric.answer.value).parameters,
                      **(parameters or {})}
    options: dict[str, Any] = {"parameters": parameters, "preset": preset,
                               "seeds": seeds, "progress": progress, "isolation": isolation}
    if processes > 1 and out is None:
        with tempfile.TemporaryDirectory() as folder:
            return evaluate(name, wanted, data, parameters=parameters, seeds=seeds, workers=workers, timeout=timeout,
                            memory=memory, sandbox=sandbox, out=Path(folder) / "result.json", preset=preset,
                            processes=processes, progress=progress)
    if out is None:
        return run(name, wanted, data, **options)
    path = Path(out)
    if keep:
        options["curves"] = curves.beside(path)
    if processes > 1:
        one = Evaluation(path, name, wanted, data, lambda: finish(name, wanted, data, path, **options),
                         parameters or {}, seeds, Training(), isolation)
        for _, message in make([one], processes, progress=progress or (lambda *_: None)):
            if message:
                raise MethodError(message)
        return Result.load(path)
    with own(path):
        return finish(name, wanted, data, path, **options)


def finish(name: str, task: Task, dataset: Dataset, path: Path, **options: Any) -> Result:
    """Evaluate with what was kept beside the result, write it, and remove what was kept.

    Args:
        name, task, dataset: as of `vsfsim.bench.evaluate.evaluate`. path: of the result. options: further ones.
    """
    part, log = path.with_suffix(".part"), log_of(path)
    log.unlink(missing_ok=True)
    before = gather(path)
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / "log"
        result = run(name, task, dataset, part=part, log=printed, **options)
        result.save(path)
        shutil.rmtree(part, ignore_errors=True)
        text = before + (printed.read_text(errors="replace") if printed.is_file() else "")
        if text:
            log.write_text(text)
    return result


def log_of(result: Path) -> Path:
    """The file beside a result that holds what the method printed: RESULT.json.log, as RESULT.log may be the user's."""
    return result.with_name(result.name + ".log")


def name_of(method: type) -> str:
    """The name module:attribute of a class.

    Raises:
        MethodError: it cannot be imported under that name, e.g. because it was written into a notebook's cell.
    """
    module, attribute = getattr(method, "__module__", None), getattr(method, "__qualname__", str(method))
    if module is None or module == "__main__" or "." in attribute:
        raise MethodError(f"the method {attribute} is not an attribute of a module that can be imported. Save it in a "
                          f"file, e.g. mine.py (in a notebook: %%writefile mine.py as the first line of the cell), and "
                          f"give 'mine:{attribute.rpartition('.')[2]}'.")
    return f"{module}:{attribute}"
