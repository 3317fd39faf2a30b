"""Trains a policy to land, by proximal policy optimisation (PPO) of stable-baselines3.

python examples/train_ppo.py --steps 100000 --out runs/ppo

It commands velocities and sees the true state. A start for training of your own: after 6144 steps
it does not land yet. With `action="rotors"` and sensors alone the task is far harder.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

import touchdown.experiments.environments  # noqa: F401  registers Touchdown-v0

SCALES = np.array([10.0] * 3 + [3.0] * 3 + [1.0] * 12 + [10.0], np.float32)
"""Of `state`: position (m), velocity (m/s), rotation and rates, height (m): inputs near 1."""


class State(gymnasium.ObservationWrapper):
    """The true state alone, scaled."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(SCALES),), np.float32)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["state"] / SCALES


def make(seed: int) -> gymnasium.Env:
    env = gymnasium.make(
        "Touchdown-v0",
        scene="flat",
        action="velocity",
        privileged=True,
        action_hz=5,
        start_height_m=6.0,
        start_spread_m=3.0,
        time_limit_s=30.0,
    )
    env.reset(seed=seed)  # resets of the trainer have no seed, and so keep this layout
    return State(env)


def evaluate(model: PPO, episodes: int) -> tuple[float, int]:
    """Mean return without exploration, and the number of gentle touchdowns on safe ground."""
    env, returns, safe = make(seed=0), [], 0
    for episode in range(episodes):
        observation, info = env.reset(seed=1000 + episode)
        total, ended = 0.0, False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            total, ended = total + float(reward), terminated or truncated
        returns.append(total)
        safe += info["outcome"] == "LANDED" and bool(info["safe"])
    env.close()
    return float(np.mean(returns)), safe


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000, help="of the environment, 0.2 s each")
    parser.add_argument("--episodes", type=int, default=20, help="of each evaluation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/ppo"))
    given = parser.parse_args()
    env = DummyVecEnv([lambda: make(given.seed)])
    model = PPO(
        "MlpPolicy", env, n_steps=min(1024, given.steps), batch_size=64, gamma=0.99,
        seed=given.seed, device="cpu", verbose=0,
    )  # fmt: skip
    for name, steps in (("before", 0), ("after", given.steps)):
        if steps:
            model.learn(steps)
        mean, safe = evaluate(model, given.episodes)
        print(
            f"{name}: mean return {mean:.2f}, {safe} of {given.episodes} landed safely", flush=True
        )
    given.out.mkdir(parents=True, exist_ok=True)
    model.save(given.out / "policy")
    print(given.out / "policy.zip")
    env.close()


if __name__ == "__main__":
    main()
