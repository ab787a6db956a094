"""Who collects the data: also a policy that nothing trains."""

import pytest
import torch as th

from sb3_gac import TGRL, AsymmetricSAC
from tests.helpers import TwoViewBandit, TwoViewChoice, small_model

ALWAYS_ALIKE = {"net_arch": [8], "log_std_bounds": (-20.0, -19.0)}


def _teacher(env):
    keys = {"actor": ["partial", "privileged"]}
    return AsymmetricSAC("MultiInputPolicy", env, role_keys=keys, policy_kwargs=ALWAYS_ALIKE, device="cpu", seed=1)


def _stored(model):
    buffer = model.replay_buffer
    rows = slice(10, buffer.n_added)
    observations = {key: th.as_tensor(entry[rows, 0]) for key, entry in buffer.observations.items()}
    return observations, th.as_tensor(buffer.actions[rows, 0])


def test_a_frozen_teacher_acts_where_behaviour_names_it():
    env = TwoViewBandit(length=3)
    model = small_model(env, cls=TGRL, teacher=_teacher(env), behaviour="teacher").learn(40)
    observations, actions = _stored(model)
    expected = model.frozen["teacher"](observations).mode
    assert actions.std() > 0
    th.testing.assert_close(actions, expected, atol=1e-5, rtol=0)


def test_a_share_of_the_episodes_is_the_frozen_teachers():
    env = TwoViewBandit(length=3)
    model = small_model(env, cls=TGRL, teacher=_teacher(env), behaviour={"teacher": 0.5, "auxiliary": 0.5}).learn(310)
    observations, actions = _stored(model)
    are_its = ((model.frozen["teacher"](observations).mode - actions).abs() < 1e-5).numpy().mean()
    assert 0.3 < are_its < 0.7
    assert len(model.returns["auxiliary"]) > 0
    assert len(model.returns["actor"]) == 0


def test_a_frozen_teacher_names_discrete_actions():
    env = TwoViewChoice(length=3)
    model = small_model(env, cls=TGRL, teacher=_teacher(env), behaviour="teacher").learn(20)
    _, actions = _stored(model)
    assert set(actions.flatten().tolist()) <= {0, 1, 2}


def test_a_name_of_nobody_is_refused():
    env = TwoViewBandit()
    with pytest.raises(ValueError, match=r"behaviour: a policy must be one of .*'teacher'.*, got 'guider'"):
        small_model(env, cls=TGRL, teacher=_teacher(env), behaviour="guider")
