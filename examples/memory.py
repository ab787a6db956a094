"""A memory for the deployed policy alone: a pendulum whose velocity is visible in training only."""

import argparse

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_gac import GAC
from sb3_gac.envs import make_vec


def main(steps: int = 15_000) -> None:
    """Train a GRU learner beside a guider and critics without memory, which see the whole state."""
    env = make_vec("sb3_gac/Pendulum-v1", 4, seed=0)
    model = GAC(
        "MultiInputPolicy",
        env,
        seed=0,
        buffer_size=steps,
        learning_starts=min(1_000, steps // 2),
        learning_rate=1e-3,
        batch_size=16,  # sequences of 16 steps to train on, after 16 steps of burn-in
        replay_buffer_kwargs={"sequence_length": 16, "burn_in": 16},
        policy_kwargs={"net_arch": [64], "rnn_type": {"partial": "gru"}, "rnn_hidden_size": 32, "rnn_net_arch": [64]},
        role_keys={"critic": ["privileged"]},
        gradient_steps=-1,
    )
    model.learn(steps)
    env.seed(100)
    mean, std = evaluate_policy(model, env, n_eval_episodes=8)
    print(f"return {mean:.0f} +- {std:.0f} (about -150 swings up and balances, -1000 does not)")

    observation, state = env.reset(), None  # acting with a memory, step by step
    for _ in range(3):
        action, state = model.predict({"partial": observation["partial"]}, state=state, deterministic=True)
        observation, _, _, _ = env.step(action)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=15_000)
    main(parser.parse_args().steps)
