"""From a scene to touches to a dataset.

The package can be called: `vsfsim.generate(scene, out)` is `vsfsim.generate.run.generate`.
"""

from collections.abc import Callable
from typing import Any

from vsfsim.core.system.interactive import make_callable


def _function() -> Callable[..., Any]:
    from vsfsim.generate.run import generate

    return generate


make_callable(__name__, _function)
