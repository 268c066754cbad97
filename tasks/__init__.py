"""Tasks: versioned TOML files; a released one never changes.

The package can be called: `vsfsim.tasks()` is `vsfsim.bench.commands.catalogue.tasks`.
"""

from collections.abc import Callable
from typing import Any

from vsfsim.core.system.interactive import make_callable


def _function() -> Callable[..., Any]:
    from vsfsim.bench.commands.catalogue import tasks

    return tasks


make_callable(__name__, _function)
