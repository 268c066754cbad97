"""One press: files, figures, refinement.

The package can be called: `vsfsim.press(scene)` is `vsfsim.press.command.press`.
"""

from collections.abc import Callable
from typing import Any

from vsfsim.core.system.interactive import make_callable


def _function() -> Callable[..., Any]:
    from vsfsim.press.command import press

    return press


make_callable(__name__, _function)
