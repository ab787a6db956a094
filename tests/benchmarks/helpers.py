"""What tests of the benchmark programs share."""

import json

from benchmarks.jobs import Job
from benchmarks.suite import RunSpec

#: All of a suite but its cells: seconds of training
SMALL_SUITE = {
    "steps": 60,
    "envs": 2,
    "preset": "small",
    "eval_every": 20,
    "eval_episodes": 1,
    "overrides": {"learning_starts": 20, "batch_size": 4, "gradient_steps": 1, "policy_kwargs": {"net_arch": [4]}},
}


def jobs_in(directory, *states):
    """With seeds from 0 on, one in each state."""
    specs = [RunSpec("gac", "Ant", 0.1, seed, 1000, 4, "small", 500, 1) for seed in range(len(states))]
    return [Job(spec, spec.directory(directory), [], state) for spec, state in zip(specs, states, strict=True)]


def evaluated(job, steps, value):
    """As a run leaves it at an evaluation."""
    job.directory.mkdir(parents=True, exist_ok=True)
    (job.directory / "timing.json").write_text(json.dumps({"steps": steps, "learner": value, "seconds": 1}))
