"""A simulator with groups of observations, as Isaac Lab's, on a stand-in of which every number is known."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gac import GPOClip
from sb3_gac.envs import GroupsVecEnv
from tests.helpers import small_model

LIMIT = 4


class Simulator(gym.Env):
    """
    Environment i falls at step 3 + i, if its time is not up first; ``policy`` is (i, step), ``critic`` (i, step, number of its
    episode). It resets by itself, and writes into the same tensors again.
    """

    def __init__(self, n_envs=4, tells_final=False, bound=np.inf):
        self.num_envs, self.device, self.tells_final = n_envs, "cpu", tells_final
        sizes = {"policy": 2, "critic": 3}
        self.single_observation_space = spaces.Dict({k: spaces.Box(-np.inf, np.inf, (n,)) for k, n in sizes.items()})
        self.single_action_space = spaces.Box(-bound, bound, (1,))
        self._groups = {name: th.zeros(n_envs, size) for name, size in sizes.items()}
        self.seeds, self.taken, self.is_closed = [], [], False

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self._steps, self._episode = th.zeros(self.num_envs), th.zeros(self.num_envs)
        return self._observe(), {}

    def step(self, action):
        assert isinstance(action, th.Tensor)
        assert (action.dtype, action.shape) == (th.float32, (self.num_envs, 1))
        self.taken.append(action.clone())
        self._steps += 1
        terminated, truncated = self._steps >= 3 + th.arange(self.num_envs), self._steps >= LIMIT
        rewards, ended = self._steps.clone(), terminated | truncated
        extras = {}
        if self.tells_final:
            extras["final"] = {name: values.clone() for name, values in self._observe().items()}
        self._steps[ended], self._episode[ended] = 0, self._episode[ended] + 1
        return self._observe(), rewards, terminated, truncated, extras

    def close(self):
        self.is_closed = True

    def _observe(self):
        columns = [th.arange(self.num_envs), self._steps, self._episode]
        for values in self._groups.values():
            for column in range(values.shape[1]):
                values[:, column] = columns[column]
        return self._groups


def _steps_to(env, n):
    """What the n-th step of an episode returns."""
    env.seed(0)
    env.reset()
    for _ in range(n):
        returned = env.step(np.zeros((4, 1)))
    return returned


def test_groups_become_partial_and_privileged_in_arrays():
    env = GroupsVecEnv(Simulator())
    assert {key: box.shape for key, box in env.observation_space.items()} == {"partial": (2,), "privileged": (3,)}
    env.seed(7)
    first = env.reset()
    assert env.simulator.seeds == [7]
    after, rewards, dones, infos = env.step(np.zeros((4, 1)))
    assert {type(values) for values in (*first.values(), *after.values(), rewards, dones)} == {np.ndarray}
    np.testing.assert_array_equal(first["partial"], [[0, 0], [1, 0], [2, 0], [3, 0]])
    np.testing.assert_array_equal(after["privileged"], [[0, 1, 0], [1, 1, 0], [2, 1, 0], [3, 1, 0]])
    assert rewards.tolist() == [1, 1, 1, 1]
    assert not dones.any()
    assert not any(info["TimeLimit.truncated"] for info in infos)


@pytest.mark.parametrize("tells_final", [False, True])
def test_ends_are_told_apart_and_have_the_last_observation_or_the_one_before(tells_final):
    env = GroupsVecEnv(Simulator(tells_final=tells_final), final_key="final" if tells_final else None)
    observation, _, dones, infos = _steps_to(env, 3)
    assert dones.tolist() == [True, False, False, False]
    assert not infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"]["privileged"].tolist() == [0, 3 if tells_final else 2, 0]
    np.testing.assert_array_equal(observation["privileged"], [[0, 0, 1], [1, 3, 0], [2, 3, 0], [3, 3, 0]])
    observation, rewards, dones, infos = env.step(np.zeros((4, 1)))
    assert dones.tolist() == [False, True, True, True]
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False, True, True], "who has fallen is not cut"
    assert infos[2]["terminal_observation"]["partial"].tolist() == [2, 4 if tells_final else 3]
    assert infos[2]["episode"]["r"] == 1 + 2 + 3 + 4
    assert infos[2]["episode"]["l"] == 4
    np.testing.assert_array_equal(observation["partial"], [[0, 1], [1, 0], [2, 0], [3, 0]])
    np.testing.assert_array_equal(rewards, [1, 4, 4, 4])


def test_all_episodes_at_once_may_end_and_a_reset_without_a_seed_begins_anew():
    env = GroupsVecEnv(Simulator(n_envs=1))
    env.seed(0)
    env.reset()
    for _ in range(3):
        observation, _, dones, _ = env.step(np.zeros((1, 1)))
    assert dones.all()
    assert observation["privileged"].tolist() == [[0, 0, 1]], "the simulator has reset it"
    env.step(np.zeros((1, 1)))
    assert env.reset()["privileged"].tolist() == [[0, 0, 0]]
    assert env.simulator.seeds == [0, None]


def test_actions_without_bounds_get_one_and_are_kept_within():
    env = GroupsVecEnv(Simulator(), max_action=2.5)
    assert env.action_space == spaces.Box(-2.5, 2.5, (1,), np.float32)
    env.reset()
    env.step(np.array([[-9.0], [9.0], [0.5], [2.0]]))
    assert env.simulator.taken[0].ravel().tolist() == [-2.5, 2.5, 0.5, 2.0]
    assert GroupsVecEnv(Simulator(bound=0.3)).action_space == spaces.Box(np.float32(-0.3), np.float32(0.3), (1,))


class Seeing(Simulator):
    """A simulator whose first group is a camera's image, in bytes."""

    def __init__(self, action_space):
        super().__init__()
        image = {"image": spaces.Box(0, 255, (3,), np.uint8)}
        self.single_observation_space = spaces.Dict({**image, **self.single_observation_space.spaces})
        self.single_action_space = action_space

    def step(self, action):
        self.taken.append(action.clone())
        nothing = th.zeros(self.num_envs)
        return self._observe(), nothing, nothing > 0, nothing > 0, {}

    def _observe(self):
        return {"image": th.zeros(self.num_envs, 3, dtype=th.uint8), **super()._observe()}


@pytest.mark.parametrize(
    ("space", "actions", "dtype"),
    [
        (spaces.Box(-1.0, 1.0, (1,)), np.array([[-0.5], [0.25], [0.75], [1.0]]), th.float32),
        (spaces.Discrete(3), np.array([0, 1, 2, 1]), th.int64),
    ],
)
def test_actions_are_of_their_own_type_whatever_that_of_the_observations(space, actions, dtype):
    env = GroupsVecEnv(Seeing(space))
    env.reset()
    env.step(actions)
    assert env.simulator.taken[0].dtype == dtype
    assert env.simulator.taken[0].tolist() == actions.tolist()


def test_noise_is_on_partial_alone_and_selections_take_indices():
    env = GroupsVecEnv(Simulator(), partial={"policy": [1]}, privileged=["critic", "policy"], noise_std=0.1)
    env.seed(0)
    first = env.reset()
    assert (first["partial"].shape, first["privileged"].shape) == ((4, 1), (4, 5))
    assert (np.abs(first["partial"]) > 1e-4).all()
    np.testing.assert_array_equal(first["privileged"][:, 1], np.zeros(4))


def test_trains_off_policy_and_on_policy_through_many_ends():
    env = VecNormalize(GroupsVecEnv(Simulator()), norm_reward=False)
    model = small_model(env, learning_starts=20, role_keys={"critic": ["privileged"]}).learn(80)
    assert model._n_updates > 0
    rollouts = GPOClip("MultiInputPolicy", GroupsVecEnv(Simulator()), n_steps=8, batch_size=8, device="cpu")
    assert rollouts.learn(64)._n_updates > 0


def test_closing_closes_the_simulator():
    env = GroupsVecEnv(Simulator())
    env.close()
    assert env.simulator.is_closed


class Plain:
    """A simulator that is none of gymnasium's environments, and has no more than it needs."""

    def __init__(self):
        inner = Simulator(n_envs=2)
        self.num_envs, self.reset, self.step = inner.num_envs, inner.reset, inner.step
        self.single_observation_space, self.single_action_space = inner.single_observation_space, inner.single_action_space


def test_a_simulator_needs_no_more_than_is_said():
    env = GroupsVecEnv(Plain())
    env.reset()
    assert env.step(np.zeros((2, 1)))[0]["partial"].tolist() == [[0, 1], [1, 1]]
    env.close()


def test_a_simulator_that_has_less_is_told():
    simulator = Plain()
    del simulator.single_action_space, simulator.step
    with pytest.raises(ValueError, match=r"simulator must have num_envs, .* lacks single_action_space, step"):
        GroupsVecEnv(simulator)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"max_action": np.inf}, "max_action must be a finite number above 0"),
        ({"max_action": 0.0}, "max_action"),
        ({"max_action": "1"}, "max_action must be a finite number above 0, got '1'"),
        ({"max_action": [1.0]}, "max_action must be a finite number above 0"),
        ({"partial": ["actor"]}, 'no entry "actor"'),
        ({"privileged": []}, "privileged must be"),
        ({"noise_std": -1.0}, "noise_std"),
    ],
)
def test_refuses_with_the_culprit_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        GroupsVecEnv(Simulator(), **arguments)


def test_episodes_end_by_the_simulator_alone():
    env = GroupsVecEnv(Simulator())
    with pytest.raises(ValueError, match="time_limit can't be set, got 5: the simulator resets its environments by itself"):
        env.set_attr("time_limit", 5)
    assert env.get_attr("time_limit") == [None] * 4


def test_a_final_key_that_is_not_there_is_named():
    env = GroupsVecEnv(Simulator(), final_key="final")
    with pytest.raises(ValueError, match=r'final_key="final", but episodes ended and the extras have \[\]'):
        _steps_to(env, 3)
