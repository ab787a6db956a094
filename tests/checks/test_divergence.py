"""Training that diverges stops, says where, and leaves a diagnosis."""

import json
import math
import pickle

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, AsymmetricMPO, AsymmetricSAC, DivergenceError
from sb3_gac.checks.divergence import check_finite_metrics
from tests.helpers import TwoViewBandit, small_model

HUGE = 1e30


class _Exploding(TwoViewBandit):
    """Rewards are finite, but their square is not, from step 21 on."""

    def __init__(self):
        super().__init__(length=4)
        self.steps = 0

    def step(self, action):
        self.steps += 1
        observation, reward, *rest = super().step(action)
        return observation, HUGE if self.steps > 20 else reward, *rest


def _diverge(logger, cls=GAC, policy="MultiInputPolicy", **arguments):
    model = cls(policy, _Exploding(), learning_starts=10, batch_size=64, buffer_size=100, seed=0, device="cpu", **arguments)
    model.set_logger(logger)
    with pytest.raises(DivergenceError) as raised:
        model.learn(60)
    return model, raised.value


SMALL = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}


@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MultiInputGruPolicy"])
@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_diverging_training_leaves_a_diagnosis(cls, policy, tmp_path):
    arguments = {"learning_rate": lambda _: 1e-3, "ent_coef": 0.3, "policy_kwargs": SMALL}
    model, error = _diverge(configure(str(tmp_path), []), cls, policy, **arguments)
    assert model.num_timesteps in range(21, 30)
    assert error.path == tmp_path / f"divergence_{model.num_timesteps}.json"
    for part in (f"after {model.num_timesteps} steps", "critic_loss", "learning_rate", str(error.path)):
        assert part in str(error)
    diagnosis = json.loads(error.path.read_text(), parse_constant=pytest.fail)  # strict JSON: neither NaN nor Infinity
    assert diagnosis == error.diagnosis
    assert (diagnosis["num_timesteps"], diagnosis["n_updates"]) == (model.num_timesteps, model._n_updates)
    assert "inf" in [value for name, value in diagnosis["metrics"].items() if name.endswith("critic_loss")]
    assert diagnosis["last_good_metrics"].keys() == diagnosis["metrics"].keys()
    assert all(math.isfinite(value) for value in diagnosis["last_good_metrics"].values())
    assert diagnosis["coefficients"]["ent_coef"] == pytest.approx(0.3)
    assert ("kl_coef" in diagnosis["coefficients"]) == (cls is GAC)
    largest = diagnosis["largest_in_a_batch"]
    assert largest["reward"] == pytest.approx(HUGE)
    assert 0 < largest["privileged"] < 0.8
    assert diagnosis["arguments"]["batch_size"] == 64
    assert diagnosis["arguments"]["policy_kwargs"]["net_arch"] == [8]


def test_metrics_are_logged_before_training_stops(tmp_path):
    model, error = _diverge(configure(str(tmp_path), []), policy_kwargs=SMALL)
    assert not math.isfinite(model.logger.name_to_value["train/guider_critic_loss"])
    assert error.diagnosis["metrics"]["guider_critic_loss"] == "inf"


def test_without_a_directory_the_error_holds_it_all():
    _, error = _diverge(Logger(folder=None, output_formats=[]), policy_kwargs=SMALL)
    assert error.path is None
    assert error.diagnosis["arguments"]["policy"] == "GACPolicy"
    assert "diagnosis of this error" in str(error)
    assert pickle.loads(pickle.dumps(error)).diagnosis == error.diagnosis  # as a cluster hands it on


def test_a_directory_that_is_gone_does_not_hide_the_divergence(tmp_path):
    logger = configure(str(tmp_path / "logs"), [])
    (tmp_path / "logs").rmdir()
    _, error = _diverge(logger, policy_kwargs=SMALL)
    assert error.path is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["learner_grad_norm", "kl", "entropy"])
def test_any_metric_counts(name, value, tmp_path):
    model = small_model().learn(20)
    good = dict(model._last_metrics)
    model.set_logger(configure(str(tmp_path), []))
    with pytest.raises(DivergenceError, match=f"NaN or infinite: {name}[.]"):
        check_finite_metrics(model, good | {name: value}, good, {})
    check_finite_metrics(model, good, good, {})


def test_observations_are_diagnosed_as_the_networks_see_them(tmp_path):
    env = VecNormalize(DummyVecEnv([TwoViewBandit]), clip_obs=0.01)
    model = small_model(env).learn(20)
    env.obs_rms["partial"].mean[:] = 100.0  # all are far below it: the largest by size, whatever their sign
    model.set_logger(configure(str(tmp_path), []))
    with pytest.raises(DivergenceError) as raised:
        check_finite_metrics(model, {"kl": math.nan}, {}, {})
    assert raised.value.diagnosis["largest_in_a_batch"]["partial"] == pytest.approx(0.01)


@pytest.mark.parametrize("cls", [GAC, AsymmetricMPO])
def test_the_check_costs_no_host_transfer(cls, monkeypatch):
    """One in a round of gradient steps, that of the metrics, where tensors are on another device than the host."""
    model = small_model(cls=cls, learning_starts=1000).learn(64)
    monkeypatch.setattr("sb3_gac.base.update._is_on_host", lambda tensor: False)
    transfers = []
    for name in ("item", "tolist", "__float__", "__bool__", "cpu", "numpy"):
        original = getattr(th.Tensor, name)
        monkeypatch.setattr(th.Tensor, name, lambda self, *a, f=original, n=name: transfers.append(n) or f(self, *a))
    model.train(gradient_steps=5, batch_size=16)
    assert transfers == ["tolist"]
    assert np.isfinite(list(model._last_metrics.values())).all()
