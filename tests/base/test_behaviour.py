"""Which policy collects: one, or shares of episodes or of environments, and each from an episode's start to its end."""

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac import GAC, AsymmetricSAC, GACShare
from sb3_gac.base.behaviour import Behaviour
from sb3_gac.base.roles import Roles
from tests.helpers import TwoViewBandit, small_model, unlike_each_other

ROLES = Roles("learner", ("guider", "other"), ("critic",), collects="guider")
STARTS = np.ones(4, dtype=bool)


def test_without_a_word_the_collecting_policy_acts_and_by_name_another_one():
    assert Behaviour(ROLES, None).choose(["learner"] * 4, STARTS, 1.0) == ["guider"] * 4
    assert Behaviour(ROLES, "learner").choose(["guider"] * 4, STARTS, 1.0) == ["learner"] * 4


def test_shares_are_shares_of_episodes_drawn_anew_at_each_start():
    np.random.seed(0)
    behaviour = Behaviour(ROLES, {"learner": 0.2, "other": 0.3})
    acting = ["guider"] * 4
    seen = []
    for _ in range(1000):
        acting = behaviour.choose(acting, STARTS, 1.0)
        seen.append(acting)
    for env in zip(*seen, strict=True):  # each environment by itself
        shares = [env.count(role) / len(env) for role in ("learner", "other", "guider")]
        assert shares == pytest.approx([0.2, 0.3, 0.5], abs=0.05)
    together = np.mean([first == "learner" and second == "learner" for first, second, *_ in seen])
    assert together == pytest.approx(0.04, abs=0.02), "environments are drawn for by themselves"


@pytest.mark.parametrize("per", ["episode", "environment"])
@pytest.mark.parametrize("shares", [{"learner": 1.0}, "learner"])
def test_whoever_has_begun_an_episode_ends_it(shares, per):
    behaviour = Behaviour(ROLES, shares, per)
    acting = ["guider", "other", "guider", "other"]
    assert behaviour.choose(acting, np.array([True, False, False, True]), 1.0) == ["learner", "other", "guider", "learner"]
    assert behaviour.choose(acting, ~STARTS, 1.0) == acting


@pytest.mark.parametrize(("share", "n_envs", "expected"), [(0.25, 4, 1), (0.5, 4, 2), (0.34, 3, 1), (0.0, 2, 0), (1.0, 2, 2)])
def test_shares_of_environments_are_the_same_ones_at_each_start(share, n_envs, expected):
    behaviour = Behaviour(ROLES, {"learner": share}, "environment", n_envs=n_envs)
    acting = ["guider"] * n_envs
    for _ in range(5):
        acting = behaviour.choose(acting, np.ones(n_envs, dtype=bool), 1.0)
        assert acting == ["learner"] * expected + ["guider"] * (n_envs - expected)


def test_a_share_may_be_a_schedule():
    behaviour = Behaviour(ROLES, {"learner": lambda progress_remaining: 1 - progress_remaining})
    assert behaviour.choose(["guider"] * 4, STARTS, 1.0) == ["guider"] * 4
    assert behaviour.choose(["guider"] * 4, STARTS, 0.0) == ["learner"] * 4


@pytest.mark.parametrize("per", ["episode", "environment"])
def test_what_the_collecting_policy_leaves_of_its_share_is_the_deployed_policys(per):
    behaviour = Behaviour(ROLES, {"guider": "linear 1 -> 0"}, per)
    assert behaviour.choose(["learner"] * 4, STARTS, 1.0) == ["guider"] * 4
    assert behaviour.choose(["guider"] * 4, STARTS, 0.0) == ["learner"] * 4
    half = behaviour.choose(["guider"] * 400, np.ones(400, dtype=bool), 0.5)
    assert half.count("learner") == pytest.approx(200, abs=50 if per == "episode" else 0)
    assert half.count("learner") + half.count("guider") == 400
    assert behaviour.acts("learner")
    assert not Behaviour(ROLES, {"guider": 1.0}).acts("learner")


@pytest.mark.parametrize("per", ["episode", "environment"])
def test_shares_of_all_policies_sum_up_to_one(per):
    thirds = {"guider": 1 / 3, "learner": 1 / 3, "other": 1 / 3}
    chosen = Behaviour(ROLES, thirds, per, n_envs=300).choose(["guider"] * 300, np.ones(300, dtype=bool), 1.0)
    assert {role: chosen.count(role) for role in thirds} == pytest.approx(dict.fromkeys(thirds, 100), abs=45)
    for shares in ({"guider": 0.5, "learner": 0.25}, {"guider": 0.5, "learner": lambda left: left / 2}):
        with pytest.raises(ValueError, match=r"sum up to 1, as no policy is left for the remainder; got \{'guider': 0.5"):
            Behaviour(ROLES, shares, per, n_envs=8).shares_at(0.5)
    with pytest.raises(ValueError, match="no policy is left"):
        small_model(cls=AsymmetricSAC, behaviour={"actor": 0.5})


def test_a_share_that_is_no_environment_is_refused_where_training_begins():
    for share, n_envs in ((0.25, 1), (0.25, 2), ("linear 0.1 -> 0.2", 2)):
        with pytest.raises(ValueError, match=rf"gives learner a share that is less than one of {n_envs} environments"):
            Behaviour(ROLES, {"learner": share}, "environment", n_envs=n_envs).check_parts()
    with pytest.raises(ValueError, match="gives guider a share that is less than one of 2"):
        Behaviour(ROLES, {"learner": 0.9}, "environment", n_envs=2).check_parts()
    for shares, n_envs in (({"learner": "linear 0 -> 1"}, 1), ({"learner": 1.0}, 3), ({"learner": 0.0}, 1), (None, 1)):
        Behaviour(ROLES, shares, "environment", n_envs=n_envs).check_parts()
    Behaviour(ROLES, {"learner": 0.25}, "episode", n_envs=1).check_parts()


def test_other_environments_are_shared_out_anew(tmp_path):
    """A model in too few of them may act and be saved, and does not learn."""
    model = small_model(DummyVecEnv([TwoViewBandit] * 4), behaviour={"learner": 0.25}, behaviour_per="environment")
    model.save(tmp_path / "model")
    for alone in (type(model).load(tmp_path / "model", env=DummyVecEnv([TwoViewBandit])), model):
        alone.set_env(DummyVecEnv([TwoViewBandit]))
        with pytest.raises(ValueError, match="less than one of 1 environments"):
            alone.learn(10)
        assert alone.num_timesteps == 0
    model.set_env(DummyVecEnv([TwoViewBandit] * 8))
    assert model.learn(30).acting == ["learner"] * 2 + ["guider"] * 6


@pytest.mark.parametrize("shares", [{"learner": 1.2}, {"learner": -0.1}, {"learner": 0.6, "other": 0.6}])
def test_shares_that_are_none_are_refused(shares):
    with pytest.raises(ValueError, match="behaviour must be shares from 0 to 1"):
        Behaviour(ROLES, shares)


@pytest.mark.parametrize("share", ["linear 0.5 -> 1.5", lambda left: 1.2 - left, lambda left: 2.0 if left == 0.5 else 0.0])
def test_shares_that_leave_their_range_later_are_refused_at_once(share):
    with pytest.raises(ValueError, match=r"behaviour must be shares from 0 to 1 .* where 0?\.?\d+ of training remains"):
        small_model(behaviour={"learner": share})


@pytest.mark.parametrize("behaviour", ["critic", "nobody", {"critic": 0.5}])
def test_who_is_no_policy_is_refused(behaviour):
    with pytest.raises(ValueError, match="behaviour"):
        Behaviour(ROLES, behaviour)


@pytest.mark.parametrize("cls", [GAC, GACShare])
def test_in_each_environment_the_one_whose_turn_it_is_acts(cls):
    policy = small_model(cls=cls).policy
    unlike_each_other(policy)
    obs = {"partial": np.random.randn(3, 2).astype(np.float32), "privileged": np.random.randn(3, 1).astype(np.float32)}

    def actions(*acting):
        return policy.behaviour_action(obs, deterministic=True, acting=acting)[0]

    guider, learner = actions(*["guider"] * 3), actions(*["learner"] * 3)
    assert (np.abs(guider - learner) > 1e-3).all()
    np.testing.assert_array_equal(actions("guider", "learner", "guider"), np.stack([guider[0], learner[1], guider[2]]))
    np.testing.assert_array_equal(actions("learner", "guider", "guider"), np.stack([learner[0], guider[1], guider[2]]))
    np.testing.assert_array_equal(policy.behaviour_action(obs, deterministic=True)[0], guider)


def _episodes(model, steps):
    """Environment, return and role of each episode that ends."""
    ended = []
    model.on_episode_end = lambda env, episode_return, role: ended.append((env, episode_return, role))
    model.learn(steps)
    return ended


def test_a_model_collects_as_it_is_told_to():
    env = DummyVecEnv([lambda: TwoViewBandit(length=3)] * 2)
    model = small_model(env, behaviour={"learner": 0.5}, behaviour_per="environment", learning_starts=0)
    assert {(env, role) for env, _, role in _episodes(model, 24)} == {(0, "learner"), (1, "guider")}
    model = small_model(env, behaviour={"learner": 0.5}, learning_starts=0)
    assert {(env, role) for env, _, role in _episodes(model, 200)} == {(n, r) for n in (0, 1) for r in ("learner", "guider")}


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_an_episode_that_warm_up_had_a_part_in_is_nobodys(cls):
    """Its return is its own all the same."""
    env = DummyVecEnv([lambda length=length: TwoViewBandit(length=length) for length in (3, 4)])
    model = small_model(env, cls, learning_starts=9, buffer_size=100)  # five steps of both environments
    ended = _episodes(model, 24)
    role = model.policy.roles.behaviour
    assert [role for env, _, role in ended if env == 0] == [None, None, role, role]
    assert [role for env, _, role in ended if env == 1] == [None, None, role]
    rewards = model.replay_buffer.rewards[:12, 0].reshape(4, 3)
    returns = [episode_return for env, episode_return, _ in ended if env == 0]
    assert returns == pytest.approx(rewards.sum(axis=1).tolist(), rel=1e-5)


def test_shares_are_asked_for_no_moment_after_the_end():
    """A last round may go beyond the steps that were asked for."""
    moments = []
    share = lambda progress: moments.append(progress) or 0.5 * progress  # noqa: E731
    small_model(behaviour={"learner": share}, train_freq=64).learn(100)
    assert min(moments) == 0.0


def test_the_first_policies_of_a_training_are_those_of_its_start():
    """The training before has left its end behind, at which the schedule's share was 1."""
    model = small_model(TwoViewBandit(length=3), behaviour={"learner": "linear 0 -> 1"}, learning_starts=0)
    model.learn(30)
    ended = _episodes(model, 3)
    assert [role for _, _, role in ended] == ["guider"]
