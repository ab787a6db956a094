"""What tests of the benchmark programs share."""

#: All of a suite but its cells: seconds of training
SMALL_SUITE = {
    "steps": 60,
    "envs": 2,
    "preset": "small",
    "eval_every": 20,
    "eval_episodes": 1,
    "overrides": {"learning_starts": 20, "batch_size": 4, "gradient_steps": 1, "policy_kwargs": {"net_arch": [4]}},
}
