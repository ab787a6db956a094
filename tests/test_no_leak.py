"""
The learner's action does not depend on what is privileged, for every kind of policy: not in predict, in evaluation, in a file,
through a shared encoder, statistics or a memory. The same checks find the leak of a learner that is told to read everything,
and of one that acts as its guider.
"""

from copy import deepcopy
from functools import partial

import numpy as np
import onnx
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from sb3_gac import GAC, RMA, AsymmetricMPO, GPOClip, GPOPenalty, OnnxPolicy, export_learner
from sb3_gac.envs import History
from tests.helpers import Sampled, small_model
from tests.registry import LINES, make

VECTOR, IMAGE = spaces.Box(-1, 1, (3,), np.float32), spaces.Box(0, 255, (3, 36, 36), np.uint8)
VECTORS = spaces.Dict(partial=VECTOR, privileged=spaces.Box(-np.inf, np.inf, (2,), np.float32))
IMAGES, BOTH_IMAGES = spaces.Dict(partial=IMAGE, privileged=VECTOR), spaces.Dict(partial=IMAGE, privileged=IMAGE)
SEVERAL = spaces.Dict(partial=VECTOR, proprio=VECTOR, privileged=VECTOR, forces=VECTOR)
CHOICE = spaces.Discrete(4)
CNN = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
SHARED = {"net_arch": [8], "share_features_extractor": True}
STATE = {"guider": ["privileged"], "critic": ["privileged"]}
READS_TWO = {"role_keys": {"learner": ["partial", "proprio"]}}
READS_ALL = {"role_keys": {"learner": ["partial", "privileged"]}}


def _recurrent(cell, env, policy_kwargs=None, cls=GAC, **arguments):
    options = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8], **(policy_kwargs or {})}
    arguments |= {"learning_starts": 20, "batch_size": 4, "seed": 0, "device": "cpu"}
    return cls(f"MultiInput{cell}Policy", env, policy_kwargs=options, **arguments)


def _on_policy(env, policy_kwargs=None, cls=GPOClip):
    options = {"net_arch": [8], **(policy_kwargs or {})}
    return cls("MultiInputPolicy", env, n_steps=10, batch_size=10, seed=0, device="cpu", policy_kwargs=options)


def _normalised(action_space=None):
    return VecNormalize(make_vec_env(lambda: Sampled(VECTORS, action_space), 2, seed=0))


KINDS = {
    **{name: partial(make, name, Sampled(VECTORS), seed=0) for name in LINES},
    "mlp, lagged": lambda: small_model(Sampled(VECTORS), guider="lagged"),
    "mlp, two networks": lambda: small_model(Sampled(VECTORS), guider="independent"),
    "mlp, shared encoder": lambda: small_model(Sampled(VECTORS), policy_kwargs=SHARED),
    "mlp, normalised": lambda: small_model(_normalised()),
    "discrete": lambda: small_model(Sampled(VECTORS, CHOICE)),
    "cnn": lambda: small_model(Sampled(IMAGES), policy_kwargs=CNN),
    "cnn, shared encoder": lambda: small_model(Sampled(BOTH_IMAGES), policy_kwargs=CNN | SHARED),
    "gru": lambda: _recurrent("Gru", Sampled(VECTORS)),
    "gru, normalised": lambda: _recurrent("Gru", _normalised()),
    "gru, shared cnn": lambda: _recurrent("Gru", Sampled(IMAGES), CNN | SHARED),
    "lstm": lambda: _recurrent("Lstm", Sampled(VECTORS)),
    "lru": lambda: _recurrent("", Sampled(VECTORS), {"rnn_type": "lru"}),
    "lstm, discrete": lambda: _recurrent("Lstm", Sampled(VECTORS, CHOICE)),
    "history, two entries": lambda: small_model(History(Sampled(SEVERAL), 3, actions=True), **READS_TWO),
    "gru of the learner alone": lambda: _recurrent("", Sampled(VECTORS), {"rnn_type": {"learner": "gru"}}),
    "cnn of the learner alone": lambda: small_model(Sampled(IMAGES), policy_kwargs=CNN, role_keys=STATE),
    "GPO, normalised": lambda: _on_policy(_normalised()),
    "GPO, cnn, discrete": lambda: _on_policy(Sampled(IMAGES, CHOICE), CNN),
    "GPO-penalty, shared encoder": lambda: _on_policy(Sampled(VECTORS), SHARED, GPOPenalty),
    "RMA, discrete, normalised": lambda: small_model(_normalised(CHOICE), cls=RMA, history=12),
    "RMA, cnn": lambda: small_model(Sampled(IMAGES), cls=RMA, history=2, policy_kwargs=CNN, batch_size=4),
    "asymmetric MPO, gru": lambda: _recurrent("Gru", Sampled(VECTORS), cls=AsymmetricMPO),
}


@pytest.fixture(scope="module", params=KINDS)
def model(request):
    """Trained for a moment; every check leaves it as it was."""
    return KINDS[request.param]().learn(40)


# --- what checks are made of ----------------------------------------------------------------------------------------------


def _privileged(model):
    """Entries that no learner of these models is meant to read."""
    return [key for key in model.observation_space.spaces if key not in ("partial", "proprio")]


def _sequence(model, steps=5, rows=3):
    """Full observations, (rows, ...) of each entry."""
    model.observation_space.seed(0)
    drawn = [[model.observation_space.sample() for _ in range(rows)] for _ in range(steps)]
    return [{key: np.stack([row[key] for row in step]) for key in step[0]} for step in drawn]


def _absurd(entry):
    return np.full_like(entry, np.nan if np.issubdtype(entry.dtype, np.floating) else 255)


def _tampered(model, sequence):
    """The sequence with other values in its privileged entries, with values that are none, and without these entries."""
    privileged, others = _privileged(model), sequence[::-1]
    yield [obs | {key: other[key] + other[key] for key in privileged} for obs, other in zip(sequence, others, strict=True)]
    yield [obs | {key: _absurd(obs[key]) for key in privileged} for obs in sequence]
    yield [{key: value for key, value in obs.items() if key not in privileged} for obs in sequence]


def _predictions(model, sequence, deterministic=True):
    """Actions and states of all steps, batched and of each first row alone, an episode starting in between."""
    th.manual_seed(0)
    results = []
    for rows in (slice(None), 0):
        state = None
        for step, obs in enumerate(sequence):
            seen = {key: value[rows] for key, value in obs.items()}
            starts = np.full(len(obs["partial"][rows]) if rows != 0 else 1, step == 3)
            action, state = model.predict(seen, state, starts, deterministic)
            results += [action, *(state or ())]
    return results


def _assert_equal_to_the_bit(results, others):
    assert all(np.array_equal(one, other) for one, other in zip(results, others, strict=True))


def _parameters_of_others(model):
    own = {id(parameter) for parameter in model.policy.deployed.parameters()}
    return [parameter for parameter in model.policy.parameters() if id(parameter) not in own]


def _with_all_else_changed(model, measure):
    """What ``measure`` gives when every parameter but the learner's, and the statistics of privileged entries, are others."""
    before, normalisation = deepcopy(model.policy.state_dict()), model.get_vec_normalize_env()
    statistics = None if normalisation is None else deepcopy(normalisation.obs_rms)
    try:
        for parameter in _parameters_of_others(model):
            parameter.data.uniform_(-3, 3)
        for key in [] if normalisation is None else _privileged(model):
            normalisation.obs_rms[key].mean += 100.0
            normalisation.obs_rms[key].var *= 9.0
        return measure()
    finally:
        model.policy.load_state_dict(before)
        if normalisation is not None:
            normalisation.obs_rms = statistics


class _Tampering(VecEnvWrapper):
    """Environments whose privileged entries hold no sense."""

    def __init__(self, venv, privileged):
        super().__init__(venv)
        self._keys = privileged

    def reset(self):
        return self._tampered(self.venv.reset())

    def step_wait(self):
        obs, *rest = self.venv.step_wait()
        return self._tampered(obs), *rest

    def _tampered(self, obs):
        return obs | {key: _absurd(obs[key]) for key in self._keys}


# --- checks, of any model -------------------------------------------------------------------------------------------------


def check_predict(model, tmp_path):
    """To the bit, samples and modes, single and batched, with all that is remembered."""
    sequence = _sequence(model)
    for deterministic in (True, False):
        expected = _predictions(model, sequence, deterministic)
        for tampered in _tampered(model, sequence):
            _assert_equal_to_the_bit(_predictions(model, tampered, deterministic), expected)


def check_gradient(model, tmp_path):
    """Of all parameters of the action's distribution: the privileged entries are not in its graph, nor are other networks."""
    obs = {key: value.float().requires_grad_() for key, value in model.policy.obs_to_tensor(_sequence(model)[0])[0].items()}
    inputs = obs if model.policy.deployed.memory is None else {key: value[None] for key, value in obs.items()}
    model.policy.set_training_mode(False)
    total = sum(value.sum() for value in model.policy.deployed.distribution(inputs))
    sources = [*obs.values(), *_parameters_of_others(model)]
    by_entry = dict(zip(obs, th.autograd.grad(total, sources, allow_unused=True)[: len(obs)], strict=True))
    assert by_entry["partial"].abs().sum() > 0
    assert [key for key, gradient in by_entry.items() if gradient is not None] == [
        key for key in obs if key not in _privileged(model)
    ]


def check_other_networks(model, tmp_path):
    """Nothing of them is in the learner's action; statistics of privileged entries are not either."""
    normalisation, raw = model.get_vec_normalize_env(), _sequence(model)

    def predictions():
        return _predictions(model, raw if normalisation is None else [normalisation.normalize_obs(obs) for obs in raw])

    _assert_equal_to_the_bit(_with_all_else_changed(model, predictions), predictions())


def check_evaluation(model, tmp_path):
    returns = []
    for env in (model.get_env(), _Tampering(model.get_env(), _privileged(model))):
        if (normalisation := model.get_vec_normalize_env()) is not None:
            normalisation.training = False
        env.seed(7)
        returns.append(evaluate_policy(model, env, n_eval_episodes=4, return_episode_rewards=True)[0])
    assert len(set(returns[0])) > 1 or isinstance(model.action_space, spaces.Discrete)
    assert returns[0] == returns[1]


def check_files(model, tmp_path):
    """Inputs for the learner's entries alone, and the same bytes whatever all other networks and statistics are."""
    path, script_path = tmp_path / "learner.onnx", tmp_path / "learner.pt"

    def exported():
        scripted = th.jit.load(str(export_learner(model, script_path, verify_on=4)))
        weights = [value.numpy() for value in scripted.state_dict().values()]
        return [np.frombuffer(export_learner(model, path, verify_on=4).read_bytes(), np.uint8), *weights], scripted

    contents, scripted = exported()
    _assert_equal_to_the_bit(_with_all_else_changed(model, exported)[0], contents)
    reads = [key for key in model.observation_space.spaces if key not in _privileged(model)]
    memory = [] if model.policy.deployed.memory is None else ["state"]
    assert [value.name for value in onnx.load(path).graph.input] == [*reads, *memory]
    assert len(list(scripted.graph.inputs())) == 1 + len(reads) + len(memory), "the module itself, and these"
    for key in _privileged(model):
        assert key.encode() not in path.read_bytes()
        assert key not in str(scripted.inlined_graph)
    with pytest.raises(ValueError, match=f"not read: {_privileged(model)}".replace("[", r"\[").replace("]", r"\]")):
        OnnxPolicy.load(path).act({key: value[0] for key, value in _sequence(model)[0].items()})


def check_saved_learner(model, tmp_path):
    """SB3's file of a policy, of the learner alone: it has no network that could read more, and acts the same."""
    deployed, sequence = model.policy.deployed, _sequence(model)
    deployed.save(tmp_path / "learner.pth")
    loaded = type(deployed).load(tmp_path / "learner.pth", device="cpu")
    assert not set(loaded.observation_space.spaces) & set(_privileged(model))
    assert loaded.rest_extractor is None
    *_, partial_alone = _tampered(model, sequence)
    expected = _predictions(model, sequence)
    _assert_equal_to_the_bit(_predictions(loaded, partial_alone), expected)
    model.save(tmp_path / "model.zip")
    _assert_equal_to_the_bit(_predictions(type(model).load(tmp_path / "model.zip", device="cpu"), partial_alone), expected)


CHECKS = [check_predict, check_gradient, check_other_networks, check_evaluation, check_files, check_saved_learner]


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_no_leak(model, check, tmp_path):
    check(model, tmp_path)


@pytest.mark.parametrize("model", [kind for kind in KINDS if kind.startswith(("gru", "lstm", "lru"))], indirect=True)
def test_the_learners_memory_in_training_holds_nothing_privileged(model):
    """While the guider acts, the learner's memory goes along, on its own entries."""
    states = []
    for sequence in (_sequence(model), next(_tampered(model, _sequence(model)))):
        state = None
        for obs in sequence:
            _, state = model.policy.behaviour_action(obs, state)
        states.append(state)
    (learner, guider), (learner_tampered, guider_tampered) = states
    assert np.array_equal(learner, learner_tampered)
    assert np.array_equal(guider, guider_tampered) == (model.policy.guider.memory is None), "or nothing was tampered with"


# --- the checks themselves ------------------------------------------------------------------------------------------------


def _acts_as_guider():
    model = small_model(Sampled(VECTORS)).learn(20)
    model.predict = model.predict_guider
    return model


LEAKS = {
    "told to read all": (lambda: small_model(Sampled(VECTORS), **READS_ALL), set(CHECKS) - {check_other_networks}),
    "memory, told to read all": (
        lambda: _recurrent("Gru", Sampled(VECTORS), **READS_ALL),
        set(CHECKS) - {check_other_networks},
    ),
    "acts as its guider": (_acts_as_guider, {check_predict, check_other_networks, check_evaluation}),
    "statistics of all": (lambda: small_model(_normalised(), **READS_ALL), {check_other_networks, check_files}),
}
PAIRS = [(leak, check) for leak, (_, checks) in LEAKS.items() for check in CHECKS if check in checks]


@pytest.mark.parametrize(("leak", "check"), PAIRS, ids=lambda value: getattr(value, "__name__", value))
def test_a_leak_is_found(leak, check, tmp_path):
    with pytest.raises((AssertionError, ValueError)):
        check(LEAKS[leak][0](), tmp_path)
