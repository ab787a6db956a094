"""SB3's contract: saving and loading of models, parameters, replay buffers, policies and actors."""

import tempfile
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import get_device

from sb3_gac import GAC, GACPolicy, GACShare
from sb3_gac.envs import PARTIAL
from sb3_gac.gac.actors import Learner
from tests.sb3_contract.helpers import AsDict, identity, make_gac, pendulum, sample_observations, vectorized


def _randomize(state_dict):
    return {name: th.rand_like(value) for name, value in state_dict.items()}


def _assert_same_tensors(state_dict, other):
    assert state_dict.keys() == other.keys()
    for name, value in state_dict.items():
        assert th.equal(value, other[name]), name


def _assert_same_parameters(params, other):
    """Of ``get_parameters()``: everything but the optimisers', whose layout is their own."""
    assert params.keys() == other.keys()
    for name in params:
        if "optim" not in name:
            _assert_same_tensors(params[name], other[name])


def _image_env():
    return AsDict(FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False), entries=(PARTIAL,))


def _image_gac(env=None, **kwargs):
    policy_kwargs = {"features_extractor_kwargs": {"cnn_output_dim": 16}}
    return make_gac(env or vectorized(_image_env), train_freq=8, policy_kwargs=policy_kwargs, buffer_size=100, **kwargs)


# --- get_parameters and set_parameters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("exact_match", [True, False])
def test_unknown_objects_are_refused(exact_match):
    model = make_gac()
    params = {**model.get_parameters(), "I_should_not_be_a_valid_object": "and_I_am_an_invalid_tensor"}
    with pytest.raises(ValueError, match="I_should_not_be_a_valid_object"):
        model.set_parameters(params, exact_match=exact_match)


def test_exact_match_misses_objects_and_tensors():
    model = make_gac().learn(30)
    original = deepcopy(model.get_parameters())
    for name in original:
        with pytest.raises(ValueError, match="do not match"):
            model.set_parameters({other: value for other, value in original.items() if other != name})
    incomplete = {name: dict(list(params.items())[:-1]) for name, params in original.items()}
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters(incomplete, exact_match=True)


def test_parameters_are_those_of_policy_and_every_optimizer():
    params = make_gac().get_parameters()
    assert next(iter(params)) == "policy"
    networks = ("learner", "guider", "guider_critic", "learner_critic")
    optimizers = {f"policy.{network}.optimizer" for network in networks}
    assert set(params) == {"policy", "ent_coef_dual.optimizer", "kl_coef_dual.optimizer"} | optimizers


def test_set_parameters_changes_what_it_is_given_and_nothing_else():
    model = make_gac().learn(30)
    original = deepcopy(model.get_parameters())
    *given, left_out = original["policy"]
    model.set_parameters({"policy": _randomize({name: original["policy"][name] for name in given})}, exact_match=False)
    changed = model.get_parameters()["policy"]
    assert th.equal(original["policy"][left_out], changed[left_out])
    for name in given:
        assert not th.allclose(original["policy"][name], changed[name]), name


def test_set_parameters_reads_a_saved_model(tmp_path):
    model, other = make_gac(seed=0).learn(30), make_gac(seed=1)
    model.save(tmp_path / "model")
    other.set_parameters(str(tmp_path / "model"))
    _assert_same_parameters(model.get_parameters(), other.get_parameters())


# --- save and load ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model_class", [GAC, GACShare])
@pytest.mark.parametrize("device", ["auto", "cpu", "cuda"])
def test_loaded_model_has_the_same_parameters_and_actions_and_learns(tmp_path, model_class, device):
    env = vectorized()
    model = make_gac(env, model_class=model_class, learning_rate=1e-3).learn(60)
    observations = sample_observations(env)
    params = {**model.get_parameters(), "policy": _randomize(model.policy.state_dict())}
    model.set_parameters(params)
    actions, _ = model.predict(observations, deterministic=True)
    model.save(tmp_path / "model.zip")

    loaded = model_class.load(str(tmp_path / "model.zip"), env=env, device=device)
    assert loaded.device.type == loaded.policy.device.type == get_device(device).type
    _assert_same_parameters(params, loaded.get_parameters())
    np.testing.assert_allclose(actions, loaded.predict(observations, deterministic=True)[0], rtol=1e-4)
    assert loaded.learn(60)._n_updates > model._n_updates


def test_tensors_are_saved_once(tmp_path):
    """What holds tensors is saved by PyTorch, and not pickled a second time with the other attributes."""
    make_gac().learn(30).save(tmp_path / "model")
    attributes, _, _ = load_from_zip_file(tmp_path / "model")
    held = [value for attribute in attributes.values() for value in (attribute, *getattr(attribute, "__dict__", {}).values())]
    assert not any(isinstance(value, th.Tensor | th.nn.Module | th.optim.Optimizer) for value in held)
    assert not {"policy", "replay_buffer", "env"} & set(attributes)


def test_training_goes_on_after_load_as_if_it_had_not_stopped(tmp_path):
    model = make_gac(seed=0).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = GAC.load(tmp_path / "model", env=pendulum())
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_logger(model.logger)
    for one in (model, loaded):
        one.set_random_seed(3)
        one.train(gradient_steps=5, batch_size=32)
    _assert_same_parameters(model.get_parameters(), loaded.get_parameters())
    assert th.equal(model.ent_coef_tensor, loaded.ent_coef_tensor)
    assert th.equal(model.kl_coef_dual.value, loaded.kl_coef_dual.value)


def test_compiled_policy_is_saved_like_any_other(tmp_path):
    model = make_gac()
    params = deepcopy(model.get_parameters())
    model.policy = th.compile(model.policy)
    model.save(tmp_path / "model")
    _assert_same_parameters(params, GAC.load(tmp_path / "model").get_parameters())


@pytest.mark.parametrize("name", ["ent_coef", "kl_coef"])
@pytest.mark.parametrize("learned", [True, False])
def test_coefficients_are_saved_and_still_learned_where_they_were(tmp_path, name, learned):
    model = make_gac(**{name: "auto" if learned else 0.01}).learn(60)
    model.save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", env=model.get_env())

    def value(of):
        return getattr(of, f"{name}_dual").value.clone()

    if name == "ent_coef":
        assert th.equal(loaded.ent_coef_tensor, model.ent_coef_tensor)
        assert (loaded.log_ent_coef is not None) == (loaded.ent_coef_optimizer is not None) == learned
        assert not learned or th.equal(loaded.log_ent_coef, model.log_ent_coef)
    before = value(loaded)
    assert th.equal(before, value(model))
    loaded.learn(40)
    assert th.equal(before, value(loaded)) != learned


def test_model_is_loaded_with_other_environments(tmp_path):
    model = make_gac(vectorized(), train_freq=4).learn(64)
    model.set_env(vectorized(), force_reset=True)
    assert model._last_obs is None
    model.learn(64)
    assert model.num_timesteps == 64
    model.set_env(model.get_env(), force_reset=False)
    assert model._last_obs is not None
    model.learn(64, reset_num_timesteps=False)
    assert model.num_timesteps == 128
    model.save(tmp_path / "model")

    loaded = GAC.load(tmp_path / "model", env=model.get_env(), force_reset=False)
    assert loaded._last_obs is not None
    assert loaded.learn(64, reset_num_timesteps=False).num_timesteps == 192
    loaded = GAC.load(tmp_path / "model", env=identity(), force_reset=True)
    assert loaded._last_obs is None
    assert loaded.learn(64, reset_num_timesteps=False).num_timesteps == 192
    loaded = GAC.load(tmp_path / "model", env=vectorized(n_envs=2))
    assert loaded.learn(64).replay_buffer.n_envs == 2


def test_model_loaded_without_environment_acts_and_gets_one_later(tmp_path):
    model = make_gac().learn(30)
    model.save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", env=None)
    obs, _ = pendulum().reset()
    np.testing.assert_array_equal(*(one.predict(obs, deterministic=True)[0] for one in (model, loaded)))
    assert loaded.get_env() is None
    loaded.set_env(pendulum())
    assert loaded.learn(30, reset_num_timesteps=False).num_timesteps == 60


def test_other_policy_kwargs_and_spaces_are_refused_at_load(tmp_path):
    make_gac(policy_kwargs={"n_critics": 3}).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"policy_kwargs .*net_arch is .8., and was .16."):
        GAC.load(tmp_path / "model", policy_kwargs={"net_arch": [8]})
    with pytest.raises(ValueError, match="spaces do not match"):
        GAC.load(tmp_path / "model", env=identity())
    same = {"net_arch": [16], "n_critics": 3}
    assert GAC.load(tmp_path / "model", env=pendulum(), policy_kwargs=same).learn(30).critic.n_critics == 3


def test_exclude_include_and_custom_objects(tmp_path):
    model = make_gac(verbose=2, target_update_interval=7)
    model.save(tmp_path / "model", exclude=["verbose"])
    assert GAC.load(tmp_path / "model").verbose != 2
    model.save(tmp_path / "model", exclude=["verbose"], include=["verbose"])
    custom_objects = {"learning_rate": 2e-5, "dummy": 1.0}
    loaded = GAC.load(tmp_path / "model", custom_objects=custom_objects, print_system_info=True)
    assert loaded.verbose == 2
    assert loaded.target_update_interval == 7
    assert loaded.learning_rate == loaded.lr_schedule(1) == 2e-5
    assert not hasattr(loaded, "dummy")
    loaded = GAC.load(tmp_path / "model", verbose=3, learning_rate=2.0)
    assert (loaded.verbose, loaded.learning_rate) == (3, 2.0)


def test_schedules_are_saved_and_give_floats(tmp_path):
    make_gac(learning_rate=lambda t: t * np.sin(1.0), target_kl=lambda t: t * np.float64(0.2)).save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model")
    for schedule, value in ((loaded.lr_schedule, 0.5 * np.sin(1.0)), (loaded.target_kl_schedule, 0.1)):
        assert type(schedule(0.5)) is float
        assert schedule(0.5) == pytest.approx(value)


def test_net_arch_none_is_the_default(tmp_path):
    make_gac(policy_kwargs={"net_arch": None}).save(tmp_path / "model")
    assert GAC.load(tmp_path / "model").actor.net_arch == [256, 256]


def test_image_model_is_loaded_with_an_environment_to_wrap(tmp_path):
    _image_gac().learn(30).save(tmp_path / "model")
    assert GAC.load(tmp_path / "model", env=_image_env()).learn(30)._n_updates > 0


@pytest.mark.filterwarnings("error")
def test_files_are_closed_and_nothing_warns(tmp_path):
    model = make_gac(vectorized(), device="cpu")
    for path in (tmp_path / "model", str(tmp_path / "model")):
        model.save(path)
        GAC.load(path, device="cpu")
        model.save_replay_buffer(path)
        model.load_replay_buffer(path)
    with tempfile.TemporaryFile() as file:
        model.save(file)
        GAC.load(file, device="cpu")
        assert not file.closed
    with tempfile.TemporaryFile() as file:
        model.save_replay_buffer(file)
        file.seek(0)
        model.load_replay_buffer(file)
        assert not file.closed


# --- replay buffer ------------------------------------------------------------------------------------------------------


def test_replay_buffer_is_saved_and_loaded(tmp_path):
    model = make_gac().learn(60)
    old = deepcopy(model.replay_buffer)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    model.replay_buffer = None
    for device in ("cpu", "cuda"):
        model.device = th.device(device)
        model.load_replay_buffer(tmp_path / "buffer.pkl")
        assert model.replay_buffer.device.type == device
    new = model.replay_buffer
    for name in ("actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(old, name), getattr(new, name))
    for key in old.observations:
        np.testing.assert_array_equal(old.observations[key], new.observations[key])
        np.testing.assert_array_equal(old.next_observations[key], new.next_observations[key])
    assert new.pos == 60


@pytest.mark.filterwarnings("error")
def test_learning_in_pieces_does_not_warn():
    model = make_gac(vectorized()).learn(50)
    model.learn(50, reset_num_timesteps=False)
    model.learn(50)
    assert model.replay_buffer.pos == 150


def test_memory_optimisation_is_ours_by_default_and_refused_by_sb3s_buffer():
    assert make_gac(optimize_memory_usage=True).learn(30)._n_updates > 0
    with pytest.raises(AssertionError, match="optimize_memory_usage"):
        make_gac(optimize_memory_usage=True, replay_buffer_class=DictReplayBuffer)


# --- policies -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("image", [False, True])
def test_policy_and_actor_are_saved_and_loaded_alone(tmp_path, image):
    env = vectorized(_image_env if image else identity)
    model = (_image_gac if image else make_gac)(env).learn(40)
    observations = sample_observations(env)
    policy = model.policy
    before = deepcopy(policy.state_dict())
    policy.load_state_dict({name: th.rand_like(value) - 0.5 for name, value in before.items()})
    params = deepcopy(policy.state_dict())
    for name in params:
        assert not th.allclose(params[name], before[name]), name
    actions, _ = policy.predict(observations, deterministic=True)
    np.testing.assert_array_equal(actions, policy.actor.predict(observations, deterministic=True)[0])
    policy.save(tmp_path / "policy.pkl")
    policy.actor.save(tmp_path / "actor.pkl")

    loaded, actor = GACPolicy.load(tmp_path / "policy.pkl"), Learner.load(tmp_path / "actor.pkl")
    _assert_same_tensors(params, loaded.state_dict())
    for one in (loaded, actor):
        np.testing.assert_allclose(actions, one.predict(observations, deterministic=True)[0], rtol=1e-4)
        np.testing.assert_allclose(actions, one.predict({PARTIAL: observations[PARTIAL]}, deterministic=True)[0], rtol=1e-4)


@pytest.mark.parametrize("options", [{"guider": "independent", "max_kl": 0.1}, {"role_keys": {"guider": ["privileged"]}}])
def test_policy_is_loaded_with_the_options_of_its_algorithm(tmp_path, options):
    model = make_gac(**options)
    model.policy.save(tmp_path / "policy.pkl")
    loaded = GACPolicy.load(tmp_path / "policy.pkl")
    assert type(loaded.guider) is type(model.policy.guider)
    assert loaded.guider.max_kl == model.policy.guider.max_kl
    assert loaded.role_keys == model.policy.role_keys
    obs, _ = pendulum().reset()
    np.testing.assert_array_equal(*(one.behaviour_action(obs, deterministic=True)[0] for one in (loaded, model.policy)))


def test_guider_and_critics_are_saved_and_loaded_alone(tmp_path):
    policy = make_gac(max_kl=0.2).policy
    for network in (policy.guider, policy.critic, policy.guider_critic):
        network.save(tmp_path / "network.pkl")
        loaded = type(network).load(tmp_path / "network.pkl")
        _assert_same_tensors(network.state_dict(), loaded.state_dict())
        assert getattr(loaded, "max_kl", None) == getattr(network, "max_kl", None)


def test_model_is_an_sb3_algorithm():
    assert issubclass(GAC, BaseAlgorithm)
    assert isinstance(make_gac().actor, Learner)
