"""Packages that can be called as functions: `vsfsim.press("indent")` beside `vsfsim.press.text`.

`vsfsim.press`, `vsfsim.generate` and `vsfsim.tasks` are packages with modules of their own, and importing one of those
binds the package to the name in `vsfsim`. A function of the same name would be replaced by it, so the package itself is
made callable (Python reference 3.3.2.1, customizing module attribute access).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, function: Callable[[], Callable[..., Any]]) -> None:
    """Let calls of a package run a function of it.

    Args:
        package: ``__name__`` of the package.
        function: returns the function; it is called at the first use, because the function's module is slow to import.
    """
    class Package(ModuleType):
        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return function()(*arguments, **options)

        @property
        def __signature__(self) -> Any:
            """For `help` and for notebooks."""
            import inspect

            return inspect.signature(function())

    sys.modules[package].__class__ = Package
