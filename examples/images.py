"""A policy that sees camera images, with critics that see the simulator's state (MUJOCO_GL=egl renders without a screen)."""

import argparse

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_gac import AsymmetricSAC, preset
from sb3_gac.envs import make_vec


def main(steps: int = 20_000) -> None:
    """Train from pixels: three frames of 64 x 64 for the actor, the state for its critics."""
    task = "HopperPixels"
    env = make_vec(f"sb3_gac/{task}-v5", 2, seed=0)
    arguments = preset(
        "pixels", algorithm="asymmetric_sac", task=task, buffer_size=steps, learning_starts=min(1_000, steps // 2)
    )
    model = AsymmetricSAC("MultiInputPolicy", env, seed=0, **arguments)
    model.learn(steps)
    env.seed(100)
    mean, std = evaluate_policy(model, env, n_eval_episodes=4)
    print(f"return {mean:.0f} +- {std:.0f}, from images alone")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    main(parser.parse_args().steps)
