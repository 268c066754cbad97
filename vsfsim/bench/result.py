"""A result: one JSON file with the task, the method, the dataset, the scores, and the raw numbers of every score."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from vsfsim.core.errors import TaskError
from vsfsim.data.disk import write_atomic

FORMAT = "vsfsim-result"
SCHEMA_VERSION = 1
QUERY_COLUMNS = ("object", "shot", "seed", "touch", "n", "sse", "sae")
READING_COLUMNS = ("object", "touch", "n", "ss")


@dataclass(frozen=True)
class Score:
    """A metric at one shot."""

    mean: float
    """Over seeds."""
    std: float
    """Over seeds, with n - 1; 0 for one seed."""
    per_seed: tuple[float, ...]
    """In the order of `Result.seeds`."""

    @classmethod
    def of(cls, per_seed: list[float]) -> Score:
        """From the values of the seeds."""
        n = len(per_seed)
        mean = math.fsum(per_seed) / n
        std = math.sqrt(math.fsum((v - mean) ** 2 for v in per_seed) / (n - 1)) if n > 1 else 0.0
        return cls(mean, std, tuple(per_seed))


@dataclass(frozen=True)
class Result:
    """One method on one task."""

    task: str
    """Name of the task."""
    task_sha256: str
    """Of its file, see `task.Task.sha256`."""
    dataset_sha256: str
    """Of the dataset's content."""
    dataset_made_by: Mapping[str, Any]
    """Version and commit of vsfsim that made the dataset."""
    method: str
    """Name of the method."""
    entry: str
    """Its module:attribute."""
    parameters: Mapping[str, Any]
    """Of the constructor, all of them."""
    observation: str
    """Name of what a reading is."""
    unit: str
    """Of a reading."""
    shots: tuple[str, ...]
    """Labels."""
    seeds: tuple[int, ...]
    """Of the support draws."""
    scores: Mapping[str, Mapping[str, Score]]
    """By metric and shot."""
    queries: Mapping[str, list]
    """Columns with one row a query touch, shot and seed: object, shot, seed, touch, number of readings n, sum of
    squared errors sse [unit^2] and of absolute errors sae [unit]."""
    timing: Mapping[str, float]
    """Seconds meta_fit_s, adapt_s and predict_s, and the numbers of calls adapts and predicts."""
    peak_memory_mib: float
    """Of the process [MiB]."""
    machine: Mapping[str, Any]
    """CPU, cores, system."""
    made_by: Mapping[str, Any]
    """Version and commit of vsfsim that scored it."""
    versions: Mapping[str, str]
    """Of the packages."""
    notes: tuple[str, ...] = ()
    """For the reader."""
    readings: Mapping[str, list] = dataclasses.field(default_factory=dict)
    """Summary of the true readings of the query touches, columns with one row a touch: object, touch, number of
    readings n, their sum of squares ss [unit^2]. They tell whether a dataset with other bits, made on another machine,
    is equivalent. Empty in results that are older than this field."""

    def save(self, path: str | Path) -> None:
        """Write the JSON; the file appears whole or not at all.

        Raises:
            TaskError: it cannot be written.
        """
        path = Path(path)
        table = {"format": FORMAT, "schema_version": SCHEMA_VERSION, **dataclasses.asdict(self)}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TaskError(f"folder {path.parent} cannot be made: {error.strerror}. Choose another --out.") from error
        write_atomic(path, (json.dumps(table, indent=1, default=str, allow_nan=False) + "\n").encode(), error=TaskError)

    @classmethod
    def load(cls, path: str | Path) -> Result:
        """Read and check a result file.

        Raises:
            TaskError: the file is not a result, it has another schema version, or a field is missing or malformed.
        """
        path = Path(path)
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise TaskError(f"result {path} cannot be read: {error}.") from error
        if not isinstance(table, dict) or table.get("format") != FORMAT:
            raise TaskError(f"{path} is not a result of `vsfsim evaluate`.")
        if table.get("schema_version") != SCHEMA_VERSION:
            raise TaskError(f"result {path} has schema version {table.get('schema_version')}; this vsfsim reads "
                            f"{SCHEMA_VERSION}. Evaluate the method again.")
        names = [f.name for f in dataclasses.fields(cls)]
        given = {"readings": {}, **{key: value for key, value in table.items()
                                    if key not in ("format", "schema_version")}}
        if set(given) != set(names):
            odd = ", ".join(sorted(set(given) ^ set(names)))
            raise TaskError(f"result {path} is malformed: missing or unknown {odd}. Evaluate the method again.")
        try:
            scores = {metric: {shot: Score(float(s["mean"]), float(s["std"]), tuple(float(v) for v in s["per_seed"]))
                               for shot, s in by_shot.items()}
                      for metric, by_shot in given["scores"].items()}
            result = cls(**{**given, "scores": scores, "shots": tuple(given["shots"]),
                            "seeds": tuple(int(s) for s in given["seeds"]), "notes": tuple(given["notes"])})
            result._check(path)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise TaskError(f"result {path} is malformed: {error!r}. Evaluate the method again.") from error
        return result

    def _check(self, path: Path) -> None:
        columns = {name: self.queries[name] for name in QUERY_COLUMNS}
        if len({len(column) for column in columns.values()}) != 1:
            raise TaskError(f"result {path} is malformed: the columns of queries have different lengths.")
        if self.readings and len({len(self.readings[name]) for name in READING_COLUMNS}) != 1:
            raise TaskError(f"result {path} is malformed: the columns of readings have different lengths.")
        for metric, by_shot in self.scores.items():
            for shot, score in by_shot.items():
                if (shot not in self.shots or len(score.per_seed) != len(self.seeds)
                    or not math.isclose(score.mean, Score.of(list(score.per_seed)).mean, rel_tol=1e-9, abs_tol=1e-12)):
                    raise TaskError(f"result {path} is malformed: {metric} at shot {shot} does not fit its "
                                    f"{len(self.seeds)} seeds.")


def readings_apart(one: Mapping[str, list], other: Mapping[str, list]) -> float | None:
    """Relative difference between two datasets' readings of the same query touches [-].

    The square root of sum (|a| - |b|)^2 over sum |b|^2, where |.| is the Euclidean norm of a touch's readings; None
    where the touches are not the same, or the readings are not kept.
    """
    if not one or not other:
        return None
    a, b = ({(name, touch): math.sqrt(ss) for name, touch, ss in zip(r["object"], r["touch"], r["ss"], strict=True)}
            for r in (one, other))
    if a.keys() != b.keys():
        return None
    size = math.fsum(v * v for v in b.values())
    return math.sqrt(math.fsum((a[key] - b[key]) ** 2 for key in b) / size) if size > 0.0 else None


def machine() -> dict[str, Any]:
    """The machine: cpu, cores, system."""
    name = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    return {"cpu": name, "cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that can change a number."""
    out = {"python": platform.python_version()}
    for package in ("numpy", "scipy", "h5py", "warp-lang", "torch"):
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            continue
    return out


def peak_memory_mib() -> float:
    """Largest resident size of this process so far [MiB]; 0 where the system does not report it."""
    try:
        import resource
    except ImportError:
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024.0 if platform.system() == "Linux" else peak / 1024.0**2
