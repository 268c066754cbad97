"""From a scene to touches to a dataset.

The package can be called: `vsfsim.generate(scene, out)` is `vsfsim.generate.run.generate`.
"""

from vsfsim.core.system.interactive import make_callable

make_callable(__name__, "vsfsim.generate.run:generate")
