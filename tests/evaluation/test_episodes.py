"""Episodes from seeds of their own, with memories that know where an episode starts."""

import numpy as np
import pytest

from sb3_gac import GAC
from sb3_gac.evaluation.episodes import run_episodes
from sb3_gac.evaluation.policies import guider_of, learner_of
from tests.evaluation.helpers import Remembering, Walk

SEEDS = range(7, 18)


def _one_after_the_other(act):
    """What a robot would do: one episode, one observation at a time."""
    expected = []
    for seed in SEEDS:
        env, total, length, is_over, state = Walk(), 0.0, 0, False, None
        observation, _ = env.reset(seed=seed)
        while not is_over:
            action, state = act(observation, state)
            observation, reward, terminated, truncated, info = env.step(action)
            total, length, is_over = total + reward, length + 1, terminated or truncated
        expected.append((total, length, info["is_success"]))
    assert len({length for _, length, _ in expected}) > 3, "episodes of several lengths"
    assert 0 < np.mean([success for *_, success in expected]) < 1
    return expected


@pytest.mark.parametrize("side_by_side", [1, 2, 5, 11])
def test_an_episode_depends_on_its_seed_alone(side_by_side):
    def act(observation, state):
        seen = [*(state or []), observation["partial"][0]]
        return np.float32([-np.clip(np.mean(seen), -1, 1)]), seen

    episodes = run_episodes(Remembering(), [Walk() for _ in range(side_by_side)], SEEDS)
    expected = _one_after_the_other(act)
    assert [(e.length, e.success) for e in episodes] == [(length, success) for _, length, success in expected]
    np.testing.assert_allclose([e.total for e in episodes], [total for total, *_ in expected], rtol=1e-5)


@pytest.mark.parametrize("who", ["learner", "guider"])
@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MultiInputGruPolicy", "MultiInputLstmPolicy"])
def test_models_with_and_without_a_memory_act_as_on_the_robot(policy, who):
    memory = {} if policy == "MultiInputPolicy" else {"rnn_hidden_size": 8, "rnn_net_arch": [8]}
    model = GAC(policy, Walk(), seed=0, buffer_size=100, policy_kwargs={"net_arch": [8], **memory}, device="cpu")
    for parameter in model.policy.parameters():
        parameter.data.mul_(4)  # so that what is remembered matters
    predict = model.predict if who == "learner" else model.predict_guider
    keys = ("partial",) if who == "learner" else ("partial", "privileged")

    def act(observation, state):
        batch = {key: observation[key][None] for key in keys}
        actions, state = predict(batch, state, np.array([state is None]), deterministic=True)
        return actions[0], state

    evaluated = learner_of(model) if who == "learner" else guider_of(model)
    assert tuple(evaluated.entries) == keys
    found = run_episodes(evaluated, [Walk() for _ in range(3)], SEEDS)
    np.testing.assert_allclose([e.total for e in found], [total for total, *_ in _one_after_the_other(act)], rtol=1e-3)


def test_the_end_of_each_episode_is_told():
    told = []
    run_episodes(Remembering(), [Walk(), Walk()], SEEDS, lambda: told.append(1))
    assert len(told) == len(SEEDS)


def test_episodes_that_may_never_end_are_warned_of(monkeypatch):
    monkeypatch.setattr("sb3_gac.evaluation.episodes._MANY", 5)

    class Long(Walk):
        def step(self, action):
            return *super().step(action)[:2], False, self.steps == 9, {}

    with pytest.warns(UserWarning, match=r"No episode has ended in 5 steps.*max_episode_steps"):
        run_episodes(Remembering(), [Long()], range(2))


def test_where_nobody_reports_successes_there_are_none():
    class Silent(Walk):
        def step(self, action):
            return *super().step(action)[:-1], {}

    assert [e.success for e in run_episodes(Remembering(), [Silent()], range(2))] == [None, None]
