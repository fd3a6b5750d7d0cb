"""The names under which Gymnasium finds flytune's environments. Light: JAX is imported with the first environment.

Since its version 1.0 Gymnasium no longer looks for environments in installed packages, so importing this module (or
`flytune.adapters.gymnasium`, which imports it) is what makes `gymnasium.make("flytune/Hover-v0")` work. Without any
import: `gymnasium.make("flytune.adapters.registration:flytune/Hover-v0")`.

Source: Gymnasium 1.0.0a1 release notes, "Removing the plugin system".
"""

from flytune.errors import require

HOVER = "flytune/Hover-v0"


def register() -> None:
    """Tell Gymnasium of `flytune/Hover-v0`; doing it again changes nothing.

    Raises:
        BadInput: Gymnasium is not installed.
    """
    gymnasium = require("gymnasium", "gymnasium")
    if HOVER not in gymnasium.registry:
        # no max_episode_steps: the horizon is the task's, and the environments keep it themselves
        gymnasium.register(
            id=HOVER,
            entry_point="flytune.adapters.gymnasium:HoverEnv",
            vector_entry_point="flytune.adapters.gymnasium:HoverVectorEnv",
        )


register()
