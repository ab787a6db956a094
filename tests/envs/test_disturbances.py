"""Delays and lost values: what arrives when, what stays as it is, and where both stand among the other wrappers."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

import sb3_gac  # noqa: F401, which registers the environments
from sb3_gac.envs import DroppedFrames, History, PreviousAction, SensorDelay, SensorNoise, SplitDictObservation, make_vec
from sb3_gac.envs.camera import CameraImage
from sb3_gac.envs.disturbances import beneath, disturb
from sb3_gac.envs.entries import RECEIVED
from sb3_gac.envs.goals import AppendDesiredGoal
from sb3_gac.envs.state import env_state, layers, restore_env_state
from tests.envs.test_wrappers import IMAGE, PAIR, Reusing, Still, Strict

ACTION = np.zeros(1, dtype=np.float32)
GOALS = spaces.Dict({key: spaces.Box(-9, 9, (2,)) for key in ("partial", "privileged", "desired_goal")})


class Counting(gym.Env):
    """``partial`` is the number of the step, ``privileged`` as well; the reward and the second component are random."""

    def __init__(self, length=10**6):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Dict(partial=box, privileged=box)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._observe(), {}

    def step(self, action):
        self.count += 1
        return self._observe(), self.np_random.normal(), False, self.count == self.length, {}

    def _observe(self):
        value = np.array([self.count, self.np_random.normal()], dtype=np.float32)
        return {"partial": value, "privileged": value.copy()}


def _seen(env, steps, key="partial", seed=0):
    """The entry from the reset on, one row per step."""
    first, _ = env.reset(seed=seed)
    return np.stack([first[key], *(env.step(ACTION)[0][key] for _ in range(steps))])


# --- delay -----------------------------------------------------------------------------------------------------------


@given(delay=st.integers(0, 6), steps=st.integers(0, 12), episodes=st.integers(1, 2))
@settings(deadline=None, max_examples=40)
def test_what_is_seen_is_what_was_measured_some_steps_before(delay, steps, episodes):
    env = SensorDelay(Counting(), delay)
    for _ in range(episodes):
        measured = _seen(Counting(), steps)
        np.testing.assert_array_equal(_seen(env, steps), measured[np.maximum(np.arange(steps + 1) - delay, 0)])


def test_a_delay_leaves_all_else():
    clean, late = Counting(), SensorDelay(Counting(), 3)
    assert late.observation_space == clean.observation_space
    clean.reset(seed=1), late.reset(seed=1)
    for _ in range(5):
        (expected, *rest), (found, *others) = clean.step(ACTION), late.step(ACTION)
        np.testing.assert_array_equal(found["privileged"], expected["privileged"])
        assert rest == others


def test_a_delayed_image_is_the_image_before():
    """Also where the environment writes every observation into the same arrays."""
    env = SensorDelay(Reusing(IMAGE), 1)
    before = env.reset(seed=0)[0]["partial"]
    for _ in range(3):
        seen = env.step(np.zeros(1, np.float32))[0]["partial"]
        np.testing.assert_array_equal(seen, before)
        assert seen.dtype == np.uint8
        before = env.unwrapped.latest["partial"].copy()


def test_another_delay_counts_from_the_next_step_on():
    env = SensorDelay(Counting(), 1)
    assert _seen(env, 4)[:, 0].tolist() == [0, 0, 1, 2, 3]
    env.steps = 3
    assert [env.step(ACTION)[0]["partial"][0] for _ in range(4)] == [3, 3, 4, 5]
    env.steps = 0
    assert env.step(ACTION)[0]["partial"][0] == 9
    assert _seen(env, 2)[:, 0].tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="steps must be an integer of at least 0"):
        env.steps = -1


@pytest.mark.parametrize("steps", [-1, 1.0, True, "2", None])
def test_a_delay_that_is_none_is_refused(steps):
    with pytest.raises(ValueError, match=r"steps must be an integer of at least 0.*got "):
        SensorDelay(Counting(), steps)


# --- lost values -----------------------------------------------------------------------------------------------------


def test_values_are_lost_as_often_as_asked_and_independently():
    n, probability = 4000, 0.3
    lost = np.diff(_seen(DroppedFrames(Counting(), probability), n)[:, 0]) == 0
    error = np.sqrt(probability * (1 - probability) / n)
    assert abs(lost.mean() - probability) < 4 * error
    assert abs(np.corrcoef(lost[1:], lost[:-1])[0, 1]) < 4 / np.sqrt(n)


@given(probability=st.floats(0, 1), seed=st.integers(0, 50))
@settings(deadline=None, max_examples=40)
def test_what_is_seen_is_the_last_value_that_arrived(probability, seed):
    measured = _seen(Counting(), 20, seed=seed)
    seen = _seen(DroppedFrames(Counting(), probability), 20, seed=seed)
    newest = seen[:, 0].astype(int)
    np.testing.assert_array_equal(seen, measured[newest], "the whole value is of one step")
    assert newest[0] == 0, "the first one always arrives"
    steps = np.arange(21)
    assert all(now in (step, before) for step, now, before in zip(steps[1:], newest[1:], newest[:-1], strict=True))


def test_ends_of_the_range():
    np.testing.assert_array_equal(_seen(DroppedFrames(Counting(), 0), 9)[:, 0], np.arange(10))
    np.testing.assert_array_equal(_seen(DroppedFrames(Counting(), 1), 9)[:, 0], np.zeros(10))


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 20))
@settings(deadline=None, max_examples=30)
def test_what_is_lost_is_lost_with_a_larger_probability_as_well(one, other, seed):
    rare, often = (_seen(DroppedFrames(Counting(), p), 30, seed=seed)[:, 0] for p in sorted([one, other]))
    arrived_rarely, arrived_often = (seen == np.arange(31) for seen in (often, rare))
    assert (arrived_often | ~arrived_rarely).all()


def test_losses_repeat_with_their_seed_and_go_on_without_one():
    env = DroppedFrames(Counting(), 0.5)
    first, again, other = (_seen(env, 30, seed=seed)[:, 0].tolist() for seed in (3, 3, 4))
    assert first == again != other
    env.reset(seed=3)
    env.reset()
    assert [env.step(ACTION)[0]["partial"][0] for _ in range(30)] == first[1:], "a reset draws nothing"


def test_losses_change_neither_the_environment_nor_the_noise():
    def noise_and_rewards(probability):
        env = SensorNoise(DroppedFrames(Counting(), probability, key="privileged"), 1.0)
        env.reset(seed=1)
        steps = [env.step(ACTION) for _ in range(5)]
        return [(observation["partial"].tolist(), reward) for observation, reward, *_ in steps]

    assert noise_and_rewards(0.0) == noise_and_rewards(0.9)


def test_two_entries_lose_their_values_independently():
    env = DroppedFrames(DroppedFrames(Counting(), 0.5), 0.5, key="privileged")
    lost = [np.diff(_seen(env, 400, key)[:, 0]) == 0 for key in ("partial", "privileged")]
    assert abs(np.corrcoef(*lost)[0, 1]) < 4 / np.sqrt(400)


@pytest.mark.parametrize("probability", [-0.1, 1.1, np.nan, np.inf, True, "0.1", None])
def test_a_probability_that_is_none_is_refused(probability):
    with pytest.raises(ValueError, match=r"probability must be a number from 0 to 1.*got "):
        DroppedFrames(Counting(), probability)


def test_what_is_shown_is_nobody_elses():
    for env in (SensorDelay(Strict(PAIR), 1), DroppedFrames(Strict(PAIR), 1.0)):
        first, _ = env.reset(seed=0)
        first["partial"] += 7
        assert env.step(ACTION)[0]["partial"].tolist() == [0, 1]


# --- among other wrappers --------------------------------------------------------------------------------------------


def test_a_late_value_has_the_noise_that_it_was_measured_with():
    def noisy():
        return SensorNoise(Counting(), 0.5)

    measured, late = _seen(noisy(), 8), _seen(SensorDelay(noisy(), 2), 8)
    np.testing.assert_array_equal(late[2:], measured[:-2])
    shown = _seen(DroppedFrames(noisy(), 0.5), 8)
    assert all(any(np.array_equal(row, other) for other in measured) for row in shown)


def test_a_registered_task_remembers_what_has_arrived():
    """noise -> delay -> losses -> history: the newest of the history is late, and the actions are not."""
    make = {"noise_std": 0.1, "privileged": "velocity"}
    measured = gym.make("sb3_gac/Pendulum-v1", **make)
    env = gym.make("sb3_gac/Pendulum-v1", **make, history=2, delay=3, drop=0.4)
    kinds = [type(layer) for layer in layers(env) if type(layer).__module__.startswith("sb3_gac")]
    assert kinds[:4] == [History, DroppedFrames, SensorDelay, SensorNoise]
    actions = np.linspace(-1, 1, 30, dtype=np.float32).reshape(-1, 1)
    values = np.stack([measured.reset(seed=2)[0]["partial"], *(measured.step(a)[0]["partial"] for a in actions)])
    seen = np.stack([env.reset(seed=2)[0]["partial"], *(env.step(a)[0]["partial"] for a in actions)])
    lost = np.random.default_rng([2, 0x6672616D65]).random(30) < 0.4
    newest = [0]
    for step, is_lost in enumerate(lost, start=1):
        newest.append(newest[-1] if is_lost else max(step - 3, 0))
    np.testing.assert_array_equal(seen[:, 2:4], values[newest])
    np.testing.assert_array_equal(seen[1:, :2], values[newest[:-1]], "the history's older value")
    np.testing.assert_array_equal(seen[1:, 4:], actions, "the action just taken")


@pytest.mark.parametrize(
    ("argument", "value"),
    [("delay", -1), ("delay", 0.5), ("drop", 1.5), ("drop", "a lot"), ("drop", np.zeros(2)), ("delay", [1, 2])],
)
def test_a_registered_task_names_the_argument(argument, value):
    with pytest.raises(ValueError, match=f"^{argument}: "):
        gym.make("sb3_gac/HalfCheetah-v5", **{argument: value})


def test_vectorised_environments_take_both_and_a_batch_takes_neither():
    env = make_vec("sb3_gac/Pendulum-v1", 2, seed=0, delay=1)
    first = env.reset()["partial"]
    np.testing.assert_array_equal(env.step(np.ones((2, 1), np.float32))[0]["partial"], first)
    for name in ("delay", "drop"):
        with pytest.raises(ValueError, match=f"{name} is for environments that are stepped one at a time.*Go1Getup"):
            make_vec("sb3_gac/Go1Getup-v0", 2, **{name: 1})


def test_an_environment_with_wrappers_of_its_own_is_disturbed_beneath_its_memory():
    env = PreviousAction(History(SensorNoise(Counting(), 0.1), 3, actions=True))
    assert beneath(env, "partial", RECEIVED) == [(env.env.env, "partial", False)]
    assert disturb(env, noise_std=0.3, delay=2, drop=0.1) is env
    assert [type(layer) for layer in layers(env)] == [
        PreviousAction,
        History,
        DroppedFrames,
        SensorDelay,
        SensorNoise,
        SensorNoise,
        Counting,
    ]
    env.reset(seed=0)
    assert env.step(ACTION)[0]["partial"].shape == (3 * 2 + 2 + 1,)


def test_added_noise_is_that_of_the_measurement_where_the_environment_has_delays_and_losses_of_its_own():
    env = History(DroppedFrames(SensorDelay(DroppedFrames(Still(PAIR), 0.0, key="privileged"), 1), 1.0), 2)
    disturb(env, noise_std=0.5, drop=0.2)
    kinds = [History, DroppedFrames, DroppedFrames, SensorDelay, SensorNoise, DroppedFrames, Still]
    assert [type(layer) for layer in layers(env)] == kinds
    shown = [env.reset(seed=0)[0]["partial"], *(env.step(ACTION)[0]["partial"] for _ in range(9))]
    assert np.abs(shown[0] - [0, 1, 0, 1]).max() > 1e-3
    np.testing.assert_array_equal(shown, [shown[0]] * 10, "a value that is shown again has the same noise")


def test_a_memory_of_another_entry_is_none_of_the_sensors():
    env = disturb(SensorNoise(History(Still(PAIR), 2, key="privileged"), 0.5), drop=1.0)
    assert [type(layer) for layer in layers(env)] == [DroppedFrames, SensorNoise, History, Still]
    shown = _seen(env, 5)
    np.testing.assert_array_equal(shown, [shown[0]] * 6, "a value that is shown again has the same noise")
    other = disturb(AppendDesiredGoal(SensorNoise(Still(GOALS), 0.5)), drop=1.0, key="privileged")
    assert [type(layer) for layer in layers(other)] == [DroppedFrames, AppendDesiredGoal, SensorNoise, Still]


def test_added_noise_and_losses_are_independent_of_those_further_out():
    space = spaces.Dict(partial=spaces.Box(-9, 9, (2,)), privileged=spaces.Box(-9, 9, (2,)))
    env = disturb(SensorNoise(History(Still(space), 1), 0.5, key="privileged"), noise_std=0.5)
    env.reset(seed=0)
    noise = np.stack([np.stack(list(env.step(ACTION)[0].values())) for _ in range(400)]) - [0, 1]
    assert abs(np.corrcoef(noise[:, 0, 0], noise[:, 1, 0])[0, 1]) < 4 / np.sqrt(400)
    counting = disturb(DroppedFrames(History(Counting(), 1), 0.5, key="privileged"), drop=0.5)
    seen = [counting.reset(seed=0)[0], *(counting.step(ACTION)[0] for _ in range(400))]
    lost = [np.diff([values[key][0] for values in seen]) == 0 for key in ("partial", "privileged")]
    assert abs(np.corrcoef(*lost)[0, 1]) < 4 / np.sqrt(400)


@pytest.mark.parametrize(
    ("wrap", "said"),
    [
        (
            lambda: SensorNoise(History(Still(PAIR), 3), 0.1),
            r"SensorNoise stands outside of History.*History\(SensorNoise\(env",
        ),
        (lambda: SensorNoise(SensorDelay(Still(PAIR), 3), 0.1), "SensorNoise stands outside of SensorDelay"),
        (lambda: SensorNoise(DroppedFrames(Still(PAIR), 0.1), 0.1), "SensorNoise stands outside of DroppedFrames"),
        (
            lambda: SensorDelay(gym.wrappers.TimeLimit(PreviousAction(Still(PAIR)), 9), 2),
            "SensorDelay stands outside of Previous",
        ),
        (lambda: DroppedFrames(History(Still(PAIR), 2), 0.1), 'DroppedFrames stands outside of History.*"partial"'),
        (lambda: SensorNoise(_split(History(Sensors(), 2, key="joints")), 0.1), 'SensorNoise .* of History.* entry "joints"'),
        (lambda: SensorNoise(AppendDesiredGoal(Still(GOALS)), 0.1), "SensorNoise stands outside of AppendDesiredGoal"),
    ],
)
def test_another_order_than_that_of_a_robot_warns(wrap, said):
    with pytest.warns(UserWarning, match=said):
        wrap()


@pytest.mark.filterwarnings("error")
def test_the_order_of_a_robot_and_wrappers_of_other_entries_do_not_warn():
    env = DroppedFrames(SensorDelay(SensorNoise(SensorNoise(Still(GOALS), 0.1), 0.1), 1), 0.1)
    PreviousAction(History(AppendDesiredGoal(SensorDelay(env, 1)), 2))
    SensorNoise(History(SensorDelay(Still(PAIR), 1, key="privileged"), 2, key="privileged"), 0.1)
    SensorNoise(AppendDesiredGoal(Still(GOALS)), 0.1, key="privileged")


def test_a_goal_is_no_measurement():
    env = gym.make("sb3_gac/FetchReach-v4", delay=3)
    other = disturb(gym.make("sb3_gac/FetchReach-v4"), delay=3)
    for each in (env, other):
        kinds = [type(layer) for layer in layers(each)]
        assert kinds.index(AppendDesiredGoal) < kinds.index(SensorDelay) < kinds.index(SensorNoise)
    first, again = (_seen_of(each) for each in (env, other))
    np.testing.assert_array_equal(first, again)


def _seen_of(env):
    actions = np.full((4, 4), 0.5, np.float32)
    return np.stack([env.reset(seed=0)[0]["partial"], *(env.step(action)[0]["partial"] for action in actions)])


class Sensors(Counting):
    """The same with the number of the step in two entries, and a goal."""

    def __init__(self):
        super().__init__()
        entry = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Dict(dict.fromkeys(("joints", "imu", "contacts", "desired_goal"), entry))

    def _observe(self):
        values = {key: np.full(2, self.count, np.float32) for key in ("joints", "imu", "contacts")}
        return {**values, "desired_goal": np.full(2, 5, np.float32)}


def _split(env, partial=("joints",), privileged=("contacts",), **kwargs):
    return SplitDictObservation(env, list(partial), list(privileged), **kwargs)


def test_a_memory_of_an_entry_that_is_split_later_is_found():
    env = disturb(_split(History(Sensors(), 3, actions=True, key="joints")), noise_std=0.1, delay=2)
    kinds = [SplitDictObservation, History, SensorDelay, SensorNoise, Sensors]
    assert [type(layer) for layer in layers(env)] == kinds
    env.reset(seed=0)
    before, now = (env.step(np.full(1, 0.1 * step, np.float32))[0]["partial"] for step in (1, 2))
    np.testing.assert_array_equal(now[:4], before[2:6], "a value keeps its noise")
    np.testing.assert_array_equal(now[6:], np.array([0.1, 0.2], np.float32), "actions are the policy's own")
    assert now[4:6] == pytest.approx(0, abs=0.5)


def test_a_goal_that_is_an_entry_of_partial_stays_as_it_is():
    env = disturb(_split(Sensors(), ("joints", "desired_goal")), noise_std=0.1, delay=1, drop=0.5)
    seen = _seen(env, 5)
    assert (seen[:, 2:] == 5).all()
    assert (seen[:, :2] % 1 != 0).all()
    kept = disturb(AppendDesiredGoal(_split(Sensors(), keep=["desired_goal"])), noise_std=0.1)
    assert [type(layer) for layer in layers(kept)] == [AppendDesiredGoal, SensorNoise, SplitDictObservation, Sensors]


def test_each_entry_of_several_is_disturbed_beneath_its_own_memory():
    env = _split(History(SensorDelay(Sensors(), 1, key="joints"), 2, key="joints"), ("joints", "imu"))
    disturb(env, noise_std=0.1, delay=2)
    seen, noise = _seen(env, 4), _seen(env, 4)[:, 4:] % 1
    np.testing.assert_array_equal(seen[1:, :2], seen[:-1, 2:4], "a value keeps its noise")
    assert seen.round()[-1].tolist() == [0, 0, 1, 1, 2, 2]
    assert len(np.unique(noise[2:])) == noise[2:].size, "each number has a noise of its own"
    with pytest.raises(ValueError, match='drop: "partial" is made of several entries'):
        disturb(env, drop=0.1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: _split(History(Sensors(), 2, key="joints"), privileged=("joints", "contacts")),
        lambda: _split(Sensors(), ("joints", "desired_goal"), keep=["joints"]),
    ],
)
def test_what_can_not_be_disturbed_for_one_entry_alone_is_refused(make):
    assert type(disturb(make())) is SplitDictObservation, "nothing is asked of it"
    for argument in ("noise_std", "delay", "drop"):
        with pytest.raises(ValueError, match=r"can't be disturbed alone.* another entry .*AppendDesiredGoal outside"):
            disturb(make(), **{argument: 1})


@pytest.mark.filterwarnings("error")
def test_a_memory_beneath_a_camera_is_none_of_the_images():
    env = disturb(CameraImage(gym.make("sb3_gac/Hopper-v5", history=4)), delay=5)
    assert [type(layer) for layer in layers(env)][:2] == [SensorDelay, CameraImage]


def test_an_environment_without_a_memory_gets_a_new_outermost_layer():
    inner = Counting()
    assert disturb(inner) is inner
    outer = disturb(inner, drop=0.5)
    assert [type(layer) for layer in layers(outer)] == [DroppedFrames, Counting]


def test_both_go_on_to_the_bit_from_a_checkpoint():
    def make():
        return gym.make("sb3_gac/Pendulum-v1", noise_std=0.1, history=2, delay=2, drop=0.5)

    env, other = make(), make()
    env.reset(seed=1)
    for _ in range(7):
        env.step(ACTION)
    state = env_state(env)
    other.reset(seed=5)
    restore_env_state(other, state)
    for _ in range(20):
        np.testing.assert_equal(other.step(ACTION)[0], env.step(ACTION)[0])
