"""One press: files, figures, refinement.

The package can be called: `vsfsim.press(scene)` is `vsfsim.press.command.press`.
"""

from vsfsim.core.system.interactive import make_callable

make_callable(__name__, "vsfsim.press.command:press")
