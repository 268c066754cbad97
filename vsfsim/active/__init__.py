"""Active touch: which touch to make next. After `import vsfsim.active`, `gymnasium.make("vsfsim/Touch-v0", task=NAME)`
makes the environment."""

from vsfsim.core.extras import require

require("active", "gymnasium")

import gymnasium  # noqa: E402  after the message that names the extra

gymnasium.register(id="vsfsim/Touch-v0", entry_point="vsfsim.active.touch_env:TouchEnv")
