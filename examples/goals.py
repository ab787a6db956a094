"""Goals and sparse rewards: hindsight experience replay for a robot arm whose velocities are visible in training only."""

import argparse

import gymnasium
from stable_baselines3 import HerReplayBuffer

import sb3_gac.envs  # noqa: F401  registers the tasks
from sb3_gac import GAC


def main(steps: int = 5_000) -> None:
    """Train with SB3's replay buffer for goals, which asks the environment for the rewards that other goals would have had."""
    env = gymnasium.make("sb3_gac/FetchReach-v4", goal_entries=True)
    model = GAC(
        "MultiInputPolicy",
        env,
        seed=0,
        replay_buffer_class=HerReplayBuffer,
        role_keys={"learner": ["partial", "desired_goal"]},
        learning_starts=min(500, steps // 2),
        gamma=0.95,
        tau=0.05,
        learning_rate=1e-3,
        policy_kwargs={"net_arch": [64, 64]},
    )
    model.learn(steps)
    reached = 0
    for episode in range(10):
        observation, info = env.reset(seed=100 + episode)
        done = False
        while not done:
            seen = {key: observation[key] for key in ("partial", "desired_goal")}
            action, _ = model.predict(seen, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
        reached += bool(info["is_success"])
    print(f"{reached} of 10 goals reached")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=5_000)
    main(parser.parse_args().steps)
