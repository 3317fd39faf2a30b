"""The simulated world for people who bring a policy: Gymnasium and dm_env.

Importing this package registers ``Touchdown-v0`` with Gymnasium where that is installed::

    import gymnasium
    import touchdown.experiments.environments

    env = gymnasium.make("Touchdown-v0", scene="crossroad")

or, in one step, ``gymnasium.make("experiments.environments:Touchdown-v0")``. With dm_env::

    from touchdown.experiments.environments.dm_environment import TouchdownEnvironment

Both need the extra ``rl``. What is sensed, done and rewarded:
`experiments.environments.landing_task`."""

from __future__ import annotations

import importlib.util

ENVIRONMENT_ID = "Touchdown-v0"


def register() -> None:
    """Makes ``gymnasium.make("Touchdown-v0")`` work; does nothing the second time."""
    import gymnasium

    if ENVIRONMENT_ID not in gymnasium.registry:
        gymnasium.register(
            id=ENVIRONMENT_ID,
            entry_point="touchdown.experiments.environments.gymnasium_env:TouchdownEnv",
        )


if importlib.util.find_spec("gymnasium") is not None:
    register()
