"""SB3's contract: the identity task is solved in a few hundred steps."""

from stable_baselines3.common.evaluation import evaluate_policy

from tests.sb3_contract.helpers import identity, make_gac


def test_learner_solves_the_identity_task():
    env = identity(-1, 1, eps=0.5)
    options = {"learning_starts": 100, "batch_size": 256, "gamma": 0.95, "learning_rate": 1e-3, "seed": 0}
    model = make_gac(env, policy_kwargs={"net_arch": [64, 64]}, **options).learn(400)
    evaluate_policy(model, env, n_eval_episodes=20, reward_threshold=90, warn=False)
