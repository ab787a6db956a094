"""SB3's contract: goal environments with HerReplayBuffer, where the learner reads entries of its own choice."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_gac import GAC
from sb3_gac.envs import PreviousAction, SplitDictObservation
from tests.helpers import TwoViewBandit
from tests.registry import algorithms, deployed_role, load, make
from tests.sb3_contract.helpers import sample_observations

LEARNER = ["observation", "desired_goal"]
with_goals = algorithms("replay", "other buffers")


def _env(**kwargs):
    return BitFlippingEnv(n_bits=4, continuous=True, **kwargs)


def _make(algorithm, env, her_kwargs=None, **kwargs):
    options = {"n_sampled_goal": 2, "goal_selection_strategy": "future", **(her_kwargs or {})}
    her = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": options}
    return make(algorithm, env, train_freq=4, role_keys={deployed_role(algorithm): LEARNER}, **her, **kwargs)


def _check_goal_environment(algorithm, image):
    policy_kwargs = {"features_extractor_kwargs": {"cnn_output_dim": 8}} if image else {}
    model = _make(algorithm, make_vec_env(lambda: _env(image_obs_space=image)), policy_kwargs=policy_kwargs).learn(20)
    assert model._n_updates > 0
    env = Monitor(_env(image_obs_space=image))
    evaluate_policy(model, env, n_eval_episodes=2)
    obs, _ = env.reset()
    action, _ = model.predict({key: obs[key] for key in LEARNER}, deterministic=True)
    np.testing.assert_array_equal(action, model.predict(obs, deterministic=True)[0])


@with_goals
def test_goal_environments(algorithm):
    _check_goal_environment(algorithm, image=False)


def test_gradient_steps_wait_for_the_first_episode():
    """The warm-up of four environments ends before any of their episodes does, none of which finds 20 bits by chance."""
    goals = make_vec_env(lambda: BitFlippingEnv(n_bits=20, continuous=True, max_steps=20), n_envs=4)
    model = _make("gac", goals, learning_starts=8)
    with pytest.warns(UserWarning, match=r"no gradient steps until .* learning_starts=8 is over: HerReplayBuffer"):
        model.learn(200)
    assert model._n_updates > 0


@with_goals
def test_a_goal_that_the_deployed_policy_does_not_read_is_told(algorithm):
    """It would learn what is best on average over goals, and nothing would fail."""
    role = deployed_role(algorithm)
    said = rf"The {role} does not read the entry \"desired_goal\".*role_keys={{\"{role}\": \['observation', 'desired_goal'\]}}"
    with pytest.warns(UserWarning, match=said):
        make(algorithm, _env(), role_keys={role: ["observation"]})
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        _make(algorithm, _env())


def test_goal_environments_with_images():
    _check_goal_environment("gac", image=True)


class _Rewarding(BitFlippingEnv):
    """Rewards with a number of its own, other goals too."""

    def __init__(self, number, **kwargs):
        super().__init__(n_bits=4, continuous=True, **kwargs)
        self.number = number

    def compute_reward(self, achieved_goal, desired_goal, _info):
        return np.full(np.shape(achieved_goal)[:-1], float(self.number))


@with_goals
def test_goals_are_rewarded_by_the_environments_that_the_model_has_now(algorithm):
    """Those before may have been closed."""
    model = _make(algorithm, make_vec_env(lambda: _Rewarding(1)), {"n_sampled_goal": 4}).learn(20)
    model.set_env(make_vec_env(lambda: _Rewarding(2)))
    rewards = model.replay_buffer.sample(200).rewards.unique()
    assert 2 in rewards
    assert model.learn(20, reset_num_timesteps=False)._n_updates > 0


def _check_goal_selection(algorithm, strategy):
    noise = NormalActionNoise(np.zeros(4), 0.1 * np.ones(4))
    env = make_vec_env(_env, n_envs=2)
    model = _make(algorithm, env, {"goal_selection_strategy": strategy}, gradient_steps=2, action_noise=noise).learn(32)
    assert isinstance(model.action_noise, VectorizedActionNoise)
    assert model._n_updates > 0


@with_goals
def test_goal_selection_with_several_environments_and_noise(algorithm):
    _check_goal_selection(algorithm, "future")


@pytest.mark.parametrize("strategy", ["final", "episode"])
def test_other_goal_selections(strategy):
    _check_goal_selection("gac", strategy)


@with_goals
def test_model_and_buffer_are_saved_and_loaded(algorithm, tmp_path):
    env = make_vec_env(_env, n_envs=2)
    model = _make(algorithm, env, seed=0).learn(32)
    observations = sample_observations(env, 5)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = load(algorithm, tmp_path / "model", env, custom_objects={"learning_rate": 2e-5}, verbose=2)
    assert (loaded.verbose, loaded.learning_rate) == (2, 2e-5)
    np.testing.assert_array_equal(*(one.predict(observations, deterministic=True)[0] for one in (model, loaded)))
    loaded.load_replay_buffer(tmp_path / "buffer.pkl", truncate_last_traj=False)
    for key, value in model.replay_buffer.observations.items():
        np.testing.assert_array_equal(value, loaded.replay_buffer.observations[key])
    assert loaded.learn(32, reset_num_timesteps=False)._n_updates > model._n_updates


@with_goals
def test_full_buffer(algorithm):
    model = _make(algorithm, make_vec_env(_env, n_envs=2), buffer_size=24, learning_starts=8).learn(48)
    assert model.replay_buffer.full


@with_goals
def test_buffer_needs_an_environment(algorithm, tmp_path):
    model = _make(algorithm, make_vec_env(_env)).learn(10)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = load(algorithm, tmp_path / "model")  # acting does without
    with pytest.raises(AssertionError, match="HerReplayBuffer"):
        loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer is None


# --- what it needs of an environment -------------------------------------------------------------------------------------


class _Goals(gym.Wrapper):
    """Goals of two numbers, rewarded by a function of one's own; none for no ``compute_reward``."""

    def __init__(self, reward, desired=(2,)):
        super().__init__(TwoViewBandit(length=5))
        self.reward = reward
        shapes = {"observation": (2,), "achieved_goal": (2,), "desired_goal": desired}
        self.observation_space = spaces.Dict({key: spaces.Box(-1, 1, shape, np.float32) for key, shape in shapes.items()})
        if reward is not None:
            self.compute_reward = reward

    def reset(self, **kwargs):
        return self.observation_space.sample(), self.env.reset(**kwargs)[1]

    def step(self, action):
        return self.observation_space.sample(), *self.env.step(action)[1:]


def _distances(achieved, desired, infos):
    return -np.linalg.norm(achieved - desired, axis=-1)


def _off(achieved, desired):
    return np.linalg.norm(achieved - desired)


def _copied_row(goals):
    """The last component is meant, and where there are as many rows, the last of these is changed."""
    changed = goals.copy()
    if len(goals) > 2:
        changed[2] = 0.5
    return changed


UNFIT = {
    "a number": (lambda *goals: float(_off(*goals[:2])), r"returns float of shape \(\) for 3 rows of goals"),
    "numpy's": (lambda *goals: _off(*goals[:2]), r"returns float32 of shape \(\) for 3 rows"),
    "a list": (lambda *goals: [0.0] * len(goals[0]), r"returns list of shape \(3,\)"),
    "the other axis": (lambda *goals: goals[0].sum(axis=0), r"returns ndarray of shape \(2,\) for 3 rows"),
    "a branch": (lambda *goals: -1.0 if (goals[0] == goals[1])[:, 0] else 0.0, "fails on 3 rows of goals .*ambiguous"),
    "a row for a component": (lambda *goals: _distances(_copied_row(goals[0]), *goals[1:]), "mixes rows of goals: it returns"),
    "a mean": (lambda *goals: _distances(*goals) - _distances(*goals).mean(), "mixes rows of goals: it returns"),
}


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("unfit", UNFIT)
def test_compute_reward_must_reward_rows_of_goals(unfit, n_envs):
    reward, message = UNFIT[unfit]
    model = _make("gac", make_vec_env(lambda: _Goals(reward), n_envs))
    with pytest.raises(ValueError, match=rf"{message}.*needs N rewards"):
        model.learn(20)
    assert model.num_timesteps == 0


def test_compute_reward_must_be_there():
    with pytest.raises(ValueError, match="The environment has no method compute_reward"):
        _make("gac", _Goals(None))


def test_compute_reward_that_reads_infos_is_taken_at_its_word():
    def reward(achieved, desired, infos):
        return _distances(achieved, desired, infos) * [info["TimeLimit.truncated"] for info in infos]

    assert _make("gac", _Goals(reward), {"copy_info_dict": True}, learning_starts=20).learn(40)._n_updates > 0
    with pytest.raises(ValueError, match=r"fails on 3 rows of goals \(KeyError\('TimeLimit.truncated'\)\)"):
        _make("gac", _Goals(reward)).learn(20)


@pytest.mark.parametrize("rewards", [_distances, lambda *goals: _distances(*goals)[:, None]])
def test_rewards_of_goals_may_be_a_column(rewards):
    assert _make("gac", _Goals(rewards), learning_starts=20).learn(40)._n_updates > 0


@with_goals
def test_an_environment_without_goals_is_named(algorithm):
    env = SplitDictObservation(_Goals(_distances), ["observation", "desired_goal"], ["achieved_goal"])
    with pytest.raises(ValueError, match=r"HerReplayBuffer replaces goals .* has \['partial', 'privileged'\].*role_keys="):
        make(algorithm, env, replay_buffer_class=HerReplayBuffer)


def test_goals_of_two_shapes_are_named():
    with pytest.raises(ValueError, match=r'"achieved_goal" in the place of "desired_goal", .* give them one shape'):
        _make("gac", _Goals(_distances, desired=(3,)))


def _shown(env, **kwargs):
    """What is warned of in the first steps."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _make("gac", env, **kwargs).learn(20)
    return [str(warning.message) for warning in caught]


def test_rewards_that_a_wrapper_changes_are_told_from_those_of_other_goals():
    """Those of relabelled goals are the inner environment's."""
    said = "The environment rewarded a step by -10, and compute_reward gives -1 for it. So HerReplayBuffer mixes"
    ten_times = gym.wrappers.TransformReward(_env(), lambda reward: 10 * reward)
    assert sum(message.startswith(said) for message in _shown(ten_times)) == 1
    assert not any("compute_reward" in message for message in _shown(_env()))


REACH = {"replay_buffer_class": HerReplayBuffer, "role_keys": {"learner": ["partial", "desired_goal"]}, "buffer_size": 100}


def _reach():
    return gym.make("sb3_gac/FetchReach-v4", goal_entries=True)


def test_rewards_are_stored_and_looked_at_as_they_were_before_they_are_normalised():
    env = VecNormalize(DummyVecEnv([lambda: Monitor(_reach())]), norm_reward=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*compute_reward")
        GAC("MultiInputPolicy", env, **REACH).learn(3)


def test_goals_in_another_form_than_the_environments_are_refused():
    model = GAC("MultiInputPolicy", VecFrameStack(DummyVecEnv([_reach]), 3), **REACH)
    with pytest.raises(ValueError, match=r"compute_reward about goals of the shape \(9,\), but .* shape \(3,\): a wrapper"):
        model.learn(3)


def test_rewards_for_the_former_goals_are_not_left_in_observations():
    """Nor in environments that the model gets later."""
    model = GAC("MultiInputPolicy", PreviousAction(_reach(), reward=True), **REACH)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"PreviousAction\(reward=True\) keeps rewards for the former goals"):
            model.learn(3)
        model.set_env(PreviousAction(_reach(), reward=True))
    GAC("MultiInputPolicy", PreviousAction(_reach()), **REACH).learn(3)


@with_goals
def test_critics_that_do_not_know_the_goal_are_refused_where_training_begins(algorithm, tmp_path):
    critic = next(iter(make(algorithm, TwoViewBandit()).policy.roles.critics))
    her = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 1000}
    model = make(algorithm, _env(), role_keys={deployed_role(algorithm): LEARNER, critic: ["observation"]}, **her)
    with pytest.raises(
        ValueError, match=rf"the critics would not know .* role_keys={{\"{critic}\": \['observation', 'desired_g"
    ):
        model.learn(3)
    model.save(tmp_path / "model")
    load(algorithm, tmp_path / "model")  # a model of an earlier version acts


def test_critics_that_read_what_the_policy_reads_learn_of_the_goal_by_it():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the policy would not know the goal either
        model = make("cosil", _env(), role_keys={"actor": ["observation"]}, replay_buffer_class=HerReplayBuffer)
    with pytest.raises(
        ValueError, match=r"critics, which read what it reads, would .* role_keys={\"actor\": \['observation', 'd"
    ):
        model.learn(3)
