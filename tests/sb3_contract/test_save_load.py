"""SB3's contract: saving and loading of models, parameters, replay buffers, policies and actors."""

import tempfile
import warnings
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import get_device

from sb3_gac import GACPolicy
from sb3_gac.algorithms import algorithm_class
from sb3_gac.envs import PARTIAL
from tests.registry import LINES, algorithms, load, load_all, make, on_policy, save_all
from tests.sb3_contract.helpers import AsDict, identity, pendulum, sample_observations, vectorized


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


def _images_in_both():
    return AsDict(FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False))


def _of_images(algorithm):
    policy_kwargs = {"features_extractor_kwargs": {"cnn_output_dim": 16}}
    return make(algorithm, vectorized(_image_env), policy_kwargs=policy_kwargs, batch_size=4)


# --- get_parameters and set_parameters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("exact_match", [True, False])
@algorithms()
def test_unknown_objects_are_refused(algorithm, exact_match):
    model = make(algorithm, pendulum())
    params = {**model.get_parameters(), "I_should_not_be_a_valid_object": "and_I_am_an_invalid_tensor"}
    with pytest.raises(ValueError, match="I_should_not_be_a_valid_object"):
        model.set_parameters(params, exact_match=exact_match)


@algorithms()
def test_exact_match_misses_objects_and_tensors(algorithm):
    model = make(algorithm, pendulum()).learn(20)
    original = deepcopy(model.get_parameters())
    for name in original:
        with pytest.raises(ValueError, match="do not match"):
            model.set_parameters({other: value for other, value in original.items() if other != name})
    incomplete = {name: dict(list(params.items())[:-1]) for name, params in original.items()}
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters(incomplete, exact_match=True)


@algorithms()
def test_parameters_are_those_of_policy_and_every_optimizer(algorithm):
    model = make(algorithm, pendulum())
    params = model.get_parameters()
    assert next(iter(params)) == "policy"
    assert {name for name in params if name.startswith("policy.")} == {
        f"policy.{name}.optimizer" for name in model.policy.trained
    }
    assert ("ent_coef_dual.optimizer" in params) == ("temperature" not in LINES[algorithm].lacks)
    assert all("optim" in name for name in params if name != "policy")


def test_parameters_of_gac():
    params = make("gac", pendulum()).get_parameters()
    networks = ("learner", "guider", "guider_critic", "learner_critic")
    optimizers = {f"policy.{network}.optimizer" for network in networks}
    assert set(params) == {"policy", "ent_coef_dual.optimizer", "kl_coef_dual.optimizer"} | optimizers


@algorithms()
def test_set_parameters_changes_what_it_is_given_and_nothing_else(algorithm):
    model = make(algorithm, pendulum()).learn(20)
    original = deepcopy(model.get_parameters())
    *given, left_out = original["policy"]
    model.set_parameters({"policy": _randomize({name: original["policy"][name] for name in given})}, exact_match=False)
    changed = model.get_parameters()["policy"]
    assert th.equal(original["policy"][left_out], changed[left_out])
    for name in given:
        assert not th.allclose(original["policy"][name], changed[name]), name


@algorithms()
def test_set_parameters_reads_a_saved_model(algorithm, tmp_path):
    model, other = make(algorithm, pendulum(), seed=0).learn(20), make(algorithm, pendulum(), seed=1)
    model.save(tmp_path / "model")
    other.set_parameters(str(tmp_path / "model"))
    _assert_same_parameters(model.get_parameters(), other.get_parameters())


# --- save and load ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@algorithms()
def test_loaded_model_has_the_same_parameters_and_actions_and_learns(algorithm, tmp_path, device):
    env = vectorized()
    model = make(algorithm, env, learning_rate=1e-3).learn(20)
    observations = sample_observations(env)
    params = {**model.get_parameters(), "policy": _randomize(model.policy.state_dict())}
    model.set_parameters(params)
    actions, _ = model.predict(observations, deterministic=True)
    model.save(tmp_path / "model.zip")

    loaded = load(algorithm, str(tmp_path / "model.zip"), env, device=device)
    assert loaded.device.type == loaded.policy.device.type == get_device(device).type
    _assert_same_parameters(params, loaded.get_parameters())
    np.testing.assert_allclose(actions, loaded.predict(observations, deterministic=True)[0], rtol=1e-4)
    assert loaded.learn(20)._n_updates > model._n_updates


@algorithms()
def test_tensors_are_saved_once(algorithm, tmp_path):
    """What holds tensors is saved by PyTorch, and not pickled a second time with the other attributes."""
    make(algorithm, pendulum()).learn(20).save(tmp_path / "model")
    attributes, _, _ = load_from_zip_file(tmp_path / "model")
    held = [value for attribute in attributes.values() for value in (attribute, *getattr(attribute, "__dict__", {}).values())]
    assert not any(isinstance(value, th.Tensor | th.nn.Module | th.optim.Optimizer) for value in held)
    assert not {"policy", "replay_buffer", "env"} & set(attributes)


@algorithms()
def test_training_goes_on_after_load_as_if_it_had_not_stopped(algorithm, tmp_path):
    model = make(algorithm, pendulum(), seed=0).learn(40)
    save_all(model, tmp_path)
    loaded = load_all(algorithm, tmp_path, pendulum())
    model.set_env(pendulum())
    for one in (model, loaded):
        one.set_random_seed(3)
        one.learn(20, reset_num_timesteps=False)
    _assert_same_parameters(model.get_parameters(), loaded.get_parameters())
    for name, coefficient in model.coefficients.items():
        assert th.equal(coefficient.value, loaded.coefficients[name].value), name


@pytest.mark.parametrize(
    ("algorithm", "shared"),
    [
        *((name, False) for name in LINES),
        *((name, True) for name, line in LINES.items() if "shared encoder" not in line.lacks),
    ],
)
def test_what_several_networks_hold_is_saved_once(algorithm, shared):
    """And a file of a version that saved it under each of its names is read as well."""
    policy = make(algorithm, _images_in_both(), policy_kwargs={"share_features_extractor": True} if shared else {}).policy
    state = policy.state_dict()
    tensors = [value.data_ptr() for value in state.values() if value.numel()]
    assert len(tensors) == len(set(tensors))
    everything = dict(policy.named_parameters(remove_duplicate=False))
    assert {value.data_ptr() for value in everything.values()} <= set(tensors)
    with_repetitions = _randomize(state)
    by_tensor = {state[name].data_ptr(): value for name, value in with_repetitions.items()}
    with_repetitions |= {name: by_tensor[value.data_ptr()] for name, value in everything.items()}
    policy.load_state_dict(with_repetitions)
    _assert_same_tensors(policy.state_dict(), {name: with_repetitions[name] for name in state})
    with pytest.raises(RuntimeError, match="Missing key"):
        policy.load_state_dict(dict(list(state.items())[1:]))


@algorithms()
def test_compiled_policy_is_saved_like_any_other(algorithm, tmp_path):
    model = make(algorithm, pendulum())
    params = deepcopy(model.get_parameters())
    model.policy = th.compile(model.policy)
    model.save(tmp_path / "model")
    _assert_same_parameters(params, load(algorithm, tmp_path / "model").get_parameters())


@pytest.mark.parametrize("name", ["ent_coef", "kl_coef"])
@pytest.mark.parametrize("learned", [True, False])
def test_coefficients_are_saved_and_still_learned_where_they_were(tmp_path, name, learned):
    model = make("gac", pendulum(), **{name: "auto" if learned else 0.01}).learn(20)
    model.save(tmp_path / "model")
    loaded = load("gac", tmp_path / "model", model.get_env())

    def value(of):
        return getattr(of, f"{name}_dual").value.clone()

    if name == "ent_coef":
        assert th.equal(loaded.ent_coef_tensor, model.ent_coef_tensor)
        assert (loaded.log_ent_coef is not None) == (loaded.ent_coef_optimizer is not None) == learned
        assert not learned or th.equal(loaded.log_ent_coef, model.log_ent_coef)
    before = value(loaded)
    assert th.equal(before, value(model))
    loaded.learn(20)
    assert th.equal(before, value(loaded)) != learned


@algorithms()
def test_model_is_loaded_with_other_environments(algorithm, tmp_path):
    model = make(algorithm, vectorized()).learn(20)
    model.set_env(vectorized(), force_reset=True)
    assert model._last_obs is None
    model.learn(20)
    assert model.num_timesteps == 20
    model.set_env(model.get_env(), force_reset=False)
    assert model._last_obs is not None
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == 40
    model.save(tmp_path / "model")

    loaded = load(algorithm, tmp_path / "model", model.get_env(), force_reset=False)
    assert loaded._last_obs is not None
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 60
    loaded = load(algorithm, tmp_path / "model", identity(), force_reset=True)
    assert loaded._last_obs is None
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 60
    loaded = load(algorithm, tmp_path / "model", vectorized(n_envs=2)).learn(20)
    assert (loaded.rollout_buffer if on_policy(algorithm) else loaded.replay_buffer).n_envs == 2


@algorithms()
def test_model_loaded_without_environment_acts_and_gets_one_later(algorithm, tmp_path):
    model = make(algorithm, pendulum()).learn(20)
    model.save(tmp_path / "model")
    loaded = load(algorithm, tmp_path / "model", None)
    obs, _ = pendulum().reset()
    np.testing.assert_array_equal(*(one.predict(obs, deterministic=True)[0] for one in (model, loaded)))
    assert loaded.get_env() is None
    loaded.set_env(pendulum())
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 40


@algorithms()
def test_other_policy_kwargs_and_spaces_are_refused_at_load(algorithm, tmp_path):
    same = {"net_arch": [16], **LINES[algorithm].policy_kwargs}
    make(algorithm, pendulum()).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"policy_kwargs .*net_arch is .8., and was .16."):
        load(algorithm, tmp_path / "model", policy_kwargs=same | {"net_arch": [8]})
    with pytest.raises(ValueError, match="spaces do not match"):
        load(algorithm, tmp_path / "model", identity())
    assert load(algorithm, tmp_path / "model", pendulum(), policy_kwargs=same).learn(20).policy.net_arch == [16]


@algorithms()
def test_exclude_include_and_custom_objects(algorithm, tmp_path):
    model = make(algorithm, pendulum(), verbose=2, gamma=0.7)
    model.save(tmp_path / "model", exclude=["verbose"])
    assert load(algorithm, tmp_path / "model").verbose != 2
    model.save(tmp_path / "model", exclude=["verbose"], include=["verbose"])
    custom_objects = {"learning_rate": 2e-5, "dummy": 1.0}
    loaded = load(algorithm, tmp_path / "model", custom_objects=custom_objects)
    assert loaded.verbose == 2
    assert loaded.gamma == 0.7
    assert loaded.learning_rate == loaded.lr_schedule(1) == 2e-5
    assert not hasattr(loaded, "dummy")
    loaded = load(algorithm, tmp_path / "model", verbose=3, learning_rate=2.0)
    assert (loaded.verbose, loaded.learning_rate) == (3, 2.0)


def _check_schedule(schedule, value):
    assert type(schedule(0.5)) is float
    assert schedule(0.5) == pytest.approx(value)


@algorithms()
def test_schedules_are_saved_and_give_floats(algorithm, tmp_path):
    make(algorithm, pendulum(), learning_rate=lambda t: t * np.sin(1.0)).save(tmp_path / "model")
    _check_schedule(load(algorithm, tmp_path / "model").lr_schedule, 0.5 * np.sin(1.0))


def test_schedules_of_targets_are_saved_and_give_floats(tmp_path):
    make("gac", pendulum(), target_kl=lambda t: t * np.float64(0.2)).save(tmp_path / "model")
    _check_schedule(load("gac", tmp_path / "model").target_kl_schedule, 0.1)


@algorithms()
def test_image_model_is_loaded_with_an_environment_to_wrap(algorithm, tmp_path):
    _of_images(algorithm).save(tmp_path / "model")
    assert load(algorithm, tmp_path / "model", _image_env()).learn(20)._n_updates > 0


@pytest.mark.filterwarnings("error")
@algorithms()
def test_files_of_models_are_closed_and_nothing_warns(algorithm, tmp_path):
    model = make(algorithm, vectorized())
    for path in (tmp_path / "model", str(tmp_path / "model")):
        model.save(path)
        load(algorithm, path)
    with tempfile.TemporaryFile() as file:
        model.save(file)
        load(algorithm, file)
        assert not file.closed


@pytest.mark.filterwarnings("error")
@algorithms("replay")
def test_files_of_replay_buffers_are_closed_and_nothing_warns(algorithm, tmp_path):
    model = make(algorithm, vectorized())
    for path in (tmp_path / "buffer", str(tmp_path / "buffer")):
        model.save_replay_buffer(path)
        model.load_replay_buffer(path)
    with tempfile.TemporaryFile() as file:
        model.save_replay_buffer(file)
        file.seek(0)
        model.load_replay_buffer(file)
        assert not file.closed


# --- replay buffer ------------------------------------------------------------------------------------------------------


@algorithms("replay")
def test_replay_buffer_is_saved_and_loaded(algorithm, tmp_path):
    model = make(algorithm, pendulum()).learn(20)
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
    assert new.pos == 20


@pytest.mark.filterwarnings("error")
@algorithms()
def test_learning_in_pieces_does_not_warn(algorithm):
    model = make(algorithm, vectorized())
    for reset_num_timesteps in (True, False, True):
        model.learn(20, reset_num_timesteps=reset_num_timesteps)
    assert on_policy(algorithm) or model.replay_buffer.pos == 60


@algorithms("replay")
def test_memory_optimisation_is_ours_by_default(algorithm):
    model = make(algorithm, pendulum(), optimize_memory_usage=True).learn(20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # SB3 would say that it cuts the last episode off
        assert model.learn(20)._n_updates > 0
    assert model.optimize_memory_usage is True


@algorithms("replay", "other buffers")
def test_memory_optimisation_is_refused_by_sb3s_buffer(algorithm):
    with pytest.raises(AssertionError, match="optimize_memory_usage"):
        make(algorithm, pendulum(), optimize_memory_usage=True, replay_buffer_class=DictReplayBuffer)


# --- policies -----------------------------------------------------------------------------------------------------------


def _check_saved_alone(model, tmp_path):
    observations = sample_observations(model.get_env())
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

    loaded = type(policy).load(tmp_path / "policy.pkl", device="cpu")
    actor = type(policy.actor).load(tmp_path / "actor.pkl", device="cpu")
    _assert_same_tensors(params, loaded.state_dict())
    for one in (loaded, actor):
        np.testing.assert_allclose(actions, one.predict(observations, deterministic=True)[0], rtol=1e-4)
        np.testing.assert_allclose(actions, one.predict({PARTIAL: observations[PARTIAL]}, deterministic=True)[0], rtol=1e-4)


@algorithms()
def test_policy_and_actor_are_saved_and_loaded_alone(algorithm, tmp_path):
    _check_saved_alone(make(algorithm, vectorized()).learn(20), tmp_path)


def test_policy_and_actor_of_images_are_saved_and_loaded_alone(tmp_path):
    _check_saved_alone(_of_images("gac").learn(20), tmp_path)


@pytest.mark.parametrize("options", [{"guider": "independent", "max_kl": 0.1}, {"role_keys": {"guider": ["privileged"]}}])
def test_policy_is_loaded_with_the_options_of_its_algorithm(tmp_path, options):
    model = make("gac", pendulum(), **options)
    model.policy.save(tmp_path / "policy.pkl")
    loaded = GACPolicy.load(tmp_path / "policy.pkl")
    assert type(loaded.guider) is type(model.policy.guider)
    assert loaded.guider.max_kl == model.policy.guider.max_kl
    assert loaded.role_keys == model.policy.role_keys
    obs, _ = pendulum().reset()
    np.testing.assert_array_equal(*(one.behaviour_action(obs, deterministic=True)[0] for one in (loaded, model.policy)))


def test_guider_and_critics_are_saved_and_loaded_alone(tmp_path):
    policy = make("gac", pendulum(), max_kl=0.2).policy
    for network in (policy.guider, policy.critic, policy.guider_critic):
        network.save(tmp_path / "network.pkl")
        loaded = type(network).load(tmp_path / "network.pkl")
        _assert_same_tensors(network.state_dict(), loaded.state_dict())
        assert getattr(loaded, "max_kl", None) == getattr(network, "max_kl", None)


@algorithms("critics")
def test_critics_are_saved_and_loaded_alone(algorithm, tmp_path):
    critic = make(algorithm, pendulum()).critic
    critic.save(tmp_path / "critic.pkl")
    _assert_same_tensors(critic.state_dict(), type(critic).load(tmp_path / "critic.pkl", device="cpu").state_dict())


@algorithms()
def test_model_is_an_sb3_algorithm(algorithm):
    assert issubclass(algorithm_class(algorithm), BaseAlgorithm)
    model = make(algorithm, pendulum())
    assert [id(p) for p in model.actor.parameters()] == [id(p) for p in model.policy.deployed.parameters()]
