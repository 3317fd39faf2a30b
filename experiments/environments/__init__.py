"""The landing task as a reinforcement-learning environment of dm_control or Gymnasium.

Importing this package registers ``Touchdown-v0`` with Gymnasium where that is installed (extra
``rl``); `suite` is ``touchdown.suite``. Actions, observations and rewards are documented in
`landing_task`."""

import importlib.util

ENVIRONMENT_ID = "Touchdown-v0"


def register() -> None:
    """Registers ``Touchdown-v0`` with Gymnasium, once."""
    import gymnasium

    if ENVIRONMENT_ID not in gymnasium.registry:
        gymnasium.register(
            id=ENVIRONMENT_ID,
            entry_point="touchdown.experiments.environments.gymnasium_env:TouchdownEnv",
        )


if importlib.util.find_spec("gymnasium") is not None:
    register()
