"""With strict_deployment, predict refuses what the learner does not read, by name; without it, it ignores that."""

import warnings

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, AsymmetricSAC
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model

FULL = {"partial": np.zeros(2, np.float32), "privileged": np.zeros(1, np.float32)}
REFUSAL = r"strict_deployment=True: the policy reads \['partial'\], but .* also has \['privileged'\]"


@pytest.mark.parametrize(
    "make",
    [
        lambda: small_model(TwoViewBandit()),
        lambda: small_model(TwoViewChoice()),
        lambda: small_model(TwoViewBandit(), cls=AsymmetricSAC),
        lambda: small_model(TwoViewBandit(), policy_kwargs={"share_features_extractor": True}),
    ],
)
def test_a_privileged_entry_is_refused_by_name(make):
    model = make()
    expected, _ = model.predict(FULL, deterministic=True)
    model.strict_deployment = True
    with pytest.raises(ValueError, match=REFUSAL):
        model.predict(FULL)
    with pytest.raises(ValueError, match=r"also has \['torque'\]"):
        model.predict({"partial": FULL["partial"], "torque": 0.0})
    for partial_alone in ({"partial": FULL["partial"]}, FULL["partial"]):
        assert np.array_equal(model.predict(partial_alone, deterministic=True)[0], expected)


def test_a_recurrent_policy_refuses_it_as_well():
    model = GAC("MultiInputGruPolicy", Recall(), policy_kwargs={"rnn_hidden_size": 8})
    model.strict_deployment = True
    observation, _ = Recall().reset(seed=0)
    _, state = model.predict({"partial": observation["partial"]})
    with pytest.raises(ValueError, match=REFUSAL):
        model.predict(observation, state)


def test_strictness_is_saved_and_may_be_asked_for_on_loading(tmp_path):
    model = small_model(TwoViewBandit()).learn(20)
    model.save(tmp_path / "lenient")
    model.strict_deployment = True
    model.save(tmp_path / "strict")
    GAC.load(tmp_path / "lenient").predict(FULL)
    for strict in (GAC.load(tmp_path / "strict"), GAC.load(tmp_path / "lenient", strict_deployment=True)):
        with pytest.raises(ValueError, match=REFUSAL):
            strict.predict(FULL)
    GAC.load(tmp_path / "strict", strict_deployment=False).predict(FULL)


def test_training_goes_on_and_evaluation_on_full_observations_does_not():
    model = small_model(TwoViewBandit())
    model.strict_deployment = True
    model.learn(20)
    with pytest.raises(ValueError, match=REFUSAL):
        evaluate_policy(model, model.get_env(), n_eval_episodes=1)


@pytest.mark.parametrize(("norm_obs", "expected"), [(True, True), (False, False)])
def test_a_model_remembers_whether_its_observations_were_normalised(norm_obs, expected):
    """Rewards' normalisation alone is nothing that deployment needs."""
    env = VecNormalize(DummyVecEnv([TwoViewBandit]), norm_obs=norm_obs)
    assert small_model(env).learn(10).trained_normalised == expected
    assert not small_model().learn(10).trained_normalised


def test_going_on_with_observations_of_another_scale_is_said():
    def normalised(**options):
        return VecNormalize(DummyVecEnv([TwoViewBandit]), **options)

    model = small_model(normalised()).learn(20)
    assert set(model.normalised_entries) == {"partial", "privileged"}
    model.set_env(TwoViewBandit())
    with pytest.warns(
        UserWarning,
        match=r"entries .* normalised, and goes on with observations that nothing normalises: wrap .* as before, in VecN",
    ):
        model.learn(5)
    assert not model.trained_normalised
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small_model(normalised(norm_obs_keys=["partial"])).learn(20).learn(5, reset_num_timesteps=False)
