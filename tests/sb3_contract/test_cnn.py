"""SB3's contract: image entries, their features extractors and the targets of these."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, VecTransposeImage, is_vecenv_wrapped

from sb3_gac.envs import PARTIAL, PRIVILEGED
from tests.registry import algorithms, load, make
from tests.sb3_contract.helpers import AsDict


def _env(entries=(PARTIAL,), channel_first=False):
    image_env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False, channel_first=channel_first)
    return AsDict(image_env, entries)


def _make(algorithm, env, policy_kwargs=None, **kwargs):
    extractor = {"features_extractor_kwargs": {"cnn_output_dim": 8}, **(policy_kwargs or {})}
    return make(algorithm, env, policy_kwargs=extractor, **{"batch_size": 4, "seed": 0, **kwargs})


def _clone(module):
    return [parameter.clone() for parameter in module.parameters()]


def _assert_equal(parameters, others):
    assert all(th.allclose(one, other) for one, other in zip(parameters, others, strict=True))


def _assert_all_differ(parameters, others):
    assert not any(th.allclose(one, other) for one, other in zip(parameters, others, strict=True))


def _check_learns_from_images(algorithm, entries, path):
    env = _env(entries)
    model = _make(algorithm, env).learn(20)
    assert is_vecenv_wrapped(model.get_env(), VecTransposeImage)
    obs, _ = env.reset()
    assert len({model.predict(obs, deterministic=False)[0].tobytes() for _ in range(5)}) == 5
    action, _ = model.predict(obs, deterministic=True)
    assert env.action_space.contains(action)
    model.save(path)
    loaded = load(algorithm, path)
    for observation in (obs, {PARTIAL: obs[PARTIAL]}):
        np.testing.assert_allclose(action, loaded.predict(observation, deterministic=True)[0])


@algorithms()
def test_images_are_transposed_learned_from_and_saved(algorithm, tmp_path):
    _check_learns_from_images(algorithm, (PARTIAL, PRIVILEGED), tmp_path / "model.zip")


@pytest.mark.parametrize("entry", [PARTIAL, PRIVILEGED])
def test_images_in_one_entry_are_transposed_learned_from_and_saved(entry, tmp_path):
    _check_learns_from_images("gac", (entry,), tmp_path / "model.zip")


@algorithms()
def test_channel_first_images_are_not_transposed(algorithm):
    env = _env(channel_first=True)
    model = _make(algorithm, env)
    assert not is_vecenv_wrapped(model.get_env(), VecTransposeImage)
    assert model.predict(env.reset()[0])[0].shape == (5,)


def test_targets_of_features_extractors():
    # Warm up without a gradient step
    model = _make("gac", _env((PARTIAL, PRIVILEGED)), learning_rate=1e-3, learning_starts=50, tau=0.0).learn(16)
    policy = model.policy
    roles = ("learner", "guider", "guider_critic", "learner_critic")
    assert len({id(getattr(policy, role).features_extractor) for role in roles}) == 4
    pairs = list(policy.pairs.values())
    assert (model.critic, model.critic_target) == pairs[1]
    for critic, target in pairs:
        _assert_equal(critic.parameters(), target.parameters())

    # A gradient step with tau = 0 moves critics alone
    critics, targets = [_clone(critic) for critic, _ in pairs], [_clone(target) for _, target in pairs]
    model.train(gradient_steps=1)
    for (critic, target), old_critic, old_target in zip(pairs, critics, targets, strict=True):
        _assert_all_differ(old_critic, critic.parameters())
        _assert_equal(old_target, target.parameters())

    # One with a learning rate of 0 moves targets alone
    model.lr_schedule = lambda _: 0.0
    model.tau = 0.01
    critics = [_clone(critic) for critic, _ in pairs]
    model.train(gradient_steps=1)
    for (critic, target), old_critic, old_target in zip(pairs, critics, targets, strict=True):
        _assert_equal(old_critic, critic.parameters())
        _assert_all_differ(old_target, target.parameters())


@pytest.mark.parametrize("normalize_images", [True, False])
@algorithms()
def test_image_like_floats_are_images_where_they_are_not_normalized_again(algorithm, normalize_images):
    env = VecNormalize(DummyVecEnv([lambda: _env(channel_first=True)]))
    model = _make(algorithm, env, policy_kwargs={"normalize_images": normalize_images})
    deployed = model.policy.deployed.features_extractor.extractors[PARTIAL]
    assert isinstance(deployed, NatureCNN) == (not normalize_images)
    convolutions = [module for module in model.policy.modules() if isinstance(module, NatureCNN)]
    assert bool(convolutions) == (not normalize_images)
    assert model.learn(20)._n_updates > 0


@pytest.mark.parametrize("normalize_images", [True, False])
def test_images_are_divided_by_255_where_asked(normalize_images):
    model = _make("gac", _env(), policy_kwargs={"normalize_images": normalize_images})
    seen = []
    for network in (model.policy.learner, model.policy.guider, model.critic, model.critic_target):
        network.features_extractor.register_forward_pre_hook(lambda _, args: seen.append(args[0][PARTIAL].max().item()))
    obs, _ = model.policy.obs_to_tensor(model.get_env().reset())
    model.policy.distributions(obs)
    model.critic(obs, th.zeros(1, 5))
    model.critic_target(obs, th.zeros(1, 5))
    assert len(seen) == 4
    assert all((value <= 1) == normalize_images for value in seen)
