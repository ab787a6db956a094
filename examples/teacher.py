"""A teacher that sees everything: the student clones it before training, with DAgger, and then trains without it."""

import argparse

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_gac import AsymmetricSAC, clone_behaviour, demonstrate, preset
from sb3_gac.envs import make_vec


def main(steps: int = 20_000) -> None:
    """Train a teacher on the full state, clone it from a noisy partial observation, and go on training the clone."""
    task, noise = "HalfCheetah", 0.1
    env = make_vec(f"sb3_gac/{task}-v5", 4, seed=0, noise_std=noise)
    setting = {"algorithm": "asymmetric_sac", "task": task, "noise": noise}
    arguments = preset("small", **setting, buffer_size=steps, learning_starts=min(2_000, steps // 2))
    everything = {"actor": ["partial", "privileged"], "critic": ["privileged"]}
    teacher = AsymmetricSAC("MultiInputPolicy", env, seed=0, **arguments | {"role_keys": everything})
    teacher.learn(steps)

    model = AsymmetricSAC("MultiInputPolicy", env, seed=0, **arguments)
    shown = demonstrate(teacher, env, steps // 4)
    tell("cloned", clone_behaviour(model, shown, gradient_steps=steps // 10))
    shown += demonstrate(teacher, env, steps // 4, student=model)
    tell("corrected where it went", clone_behaviour(model, shown, gradient_steps=steps // 10))
    for name, policy in (("teacher", teacher), ("clone", model)):
        print(f"the {name} returns {evaluate_policy(policy, env, n_eval_episodes=4)[0]:.0f}")
    model.learn(steps)
    print(f"trained on, it returns {evaluate_policy(model, env, n_eval_episodes=4)[0]:.0f}")


def tell(what: str, error: dict[str, float]) -> None:
    """Print the error of a clone before and after its training."""
    print(f"{what}: mean squared error of actions {error['before']:.3f} before, {error['after']:.3f} after")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    main(parser.parse_args().steps)
