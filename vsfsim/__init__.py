"""vsfsim: simulated touch of heterogeneous deformable objects, and a benchmark of stiffness estimators.

Six functions do what the commands do, by the same code:

- `vsfsim.press(scene)`: press a probe into an object;
- `vsfsim.generate(scene, out)`: make a dataset;
- `vsfsim.load(folder)`: open a dataset;
- `vsfsim.tasks()` and `vsfsim.methods()`: what can be evaluated;
- `vsfsim.evaluate(method, task)`: score a method.

Each is imported at its first use: `import vsfsim` takes milliseconds and needs no package besides the standard library.
"""

from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"
__all__ = ["__version__", "evaluate", "generate", "load", "methods", "press", "tasks"]

if TYPE_CHECKING:
    from vsfsim.bench.commands.catalogue import methods, tasks
    from vsfsim.bench.evaluate import evaluate
    from vsfsim.data.dataset import load
    from vsfsim.generate.run import generate
    from vsfsim.press.command import press


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'vsfsim' has no attribute '{name}'")
    from pkgutil import resolve_name

    # the others are packages that can be called
    return resolve_name({"load": "vsfsim.data.dataset:load", "evaluate": "vsfsim.bench.evaluate:evaluate",
                         "methods": "vsfsim.bench.commands.catalogue:methods"}.get(name, f"vsfsim.{name}"))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
