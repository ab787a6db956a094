"""SB3's contract: the identity task is solved in a few hundred steps."""

from stable_baselines3.common.evaluation import evaluate_policy

from tests.registry import algorithms, is_taught, make, on_policy
from tests.sb3_contract.helpers import identity

OFF_POLICY = {"learning_starts": 60, "train_freq": 1, "tau": 0.05}
ON_POLICY = {"n_steps": 64, "n_epochs": 4}


# Asymmetric MPO's bounds let no policy move that far in so few steps; what it learns: tests/baselines/test_asymmetric_mpo.py
@algorithms(but=("asymmetric_mpo",))
def test_the_deployed_policy_solves_the_identity_task(algorithm):
    env = identity(-1, 1, eps=0.5)
    of_method = {"teacher_coef": 0.0} if is_taught(algorithm) else {}  # theirs knows nothing
    of_method |= {"phase_1_steps": 190} if algorithm == "rma" else {}
    of_method |= ON_POLICY if on_policy(algorithm) else OFF_POLICY
    options = {"batch_size": 64, "gamma": 0.5, "learning_rate": 3e-3, "seed": 0, "policy_kwargs": {"net_arch": [32]}}
    model = make(algorithm, env, **options, **of_method).learn(640 if on_policy(algorithm) else 220)
    evaluate_policy(model, env, n_eval_episodes=2, reward_threshold=75, warn=False)
