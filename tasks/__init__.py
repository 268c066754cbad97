"""Tasks: versioned TOML files; a released one never changes.

The package can be called: `vsfsim.tasks()` is `vsfsim.bench.commands.catalogue.tasks`.
"""

from vsfsim.core.system.interactive import make_callable

make_callable(__name__, "vsfsim.bench.commands.catalogue:tasks")
