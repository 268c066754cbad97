"""Whose a result is: a method's, a ceiling's, or somebody's who only claims the name; and its label in a table."""

from __future__ import annotations

from vsfsim.bench.result import Result
from vsfsim.core.shelf import ceilings, methods


def is_ceiling(result: Result) -> bool:
    """Whether a result is of a ceiling (`vsfsim.bench.commands.ceiling`)."""
    entry = ceilings().get(result.method)
    return entry is not None and entry.value == result.entry


def claimed(result: Result) -> bool:
    """Whether a result has the name of a method that ships, and is of another one or of a file of predictions."""
    entry = methods().get(result.method)
    if entry is None or entry.dist is None or entry.dist.name != "vsfsim":
        return False
    return result.entry != entry.value or result.package.get("name", "vsfsim") not in ("vsfsim", "")


def labels_of(results: list[Result]) -> list[str]:
    """The method's name and preset; where it has several rows, with the parameters in which they differ."""
    out = []
    for result in results:
        twins = [other.parameters for other in results
                 if (other.method, other.preset) == (result.method, result.preset)]
        differ = [f"{key}={value}" for key, value in result.parameters.items()
                  if value != "" and any(twin.get(key) != value for twin in twins)]
        words = [*filter(None, ["claimed" if claimed(result) else "", result.preset]), *differ]
        out.append(f"{result.method} ({', '.join(words)})" if words else result.method)
    return out
