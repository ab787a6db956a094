"""Policies that remember: GAC and the SAC family with GRU and LSTM, on discrete and continuous actions."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, AsymmetricSAC, CompactDictReplayBuffer, GACShare, GACWithoutQ
from tests.helpers import Recall, unlike_each_other

ALGORITHMS = [GAC, AsymmetricSAC]
POLICIES = ["MultiInputGruPolicy", "MultiInputLstmPolicy"]
SMALL = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}


def _model(cls=GAC, policy="MultiInputGruPolicy", env=None, **arguments):
    defaults = {"learning_starts": 40, "batch_size": 4, "buffer_size": 1000, "seed": 0, "device": "cpu"}
    env = Recall() if env is None else env
    return cls(policy, env, **{**defaults, "policy_kwargs": dict(SMALL), **arguments})


def _observations(steps, batch):
    return {"partial": th.rand(steps, batch, 4), "privileged": th.rand(steps, batch, 3)}


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_the_deployed_policy_remembers_what_it_saw(cls):
    """The cue is gone when it is asked for: 1 for a memory, 1/3 by chance."""
    model = _model(
        cls,
        learning_starts=200,
        batch_size=32,
        learning_rate=1e-2,
        ent_coef=0.02,
        tau=0.05,
        gamma=0.9,
        train_freq=2,
        policy_kwargs={"net_arch": [16], "rnn_hidden_size": 16, "rnn_net_arch": [16]},
    ).learn(1200)
    returns, _ = evaluate_policy(model, make_vec_env(Recall, 1, seed=1), n_eval_episodes=60, warn=False)
    assert returns > 0.9


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("continuous", [False, True])
def test_acting_step_by_step_is_what_training_sees(cls, policy, continuous):
    model = _model(cls, policy, Recall(continuous=continuous))
    network = model.policy.deployed
    sequence = _observations(5, 3)
    with th.no_grad():
        at_once = network.distribution(sequence)
        state, starts = None, np.ones(3, dtype=bool)
        for step in range(5):
            one = {key: value[step] for key, value in sequence.items()}
            distribution, state = network.remember(one, state, starts)
            for part, whole in zip(distribution, at_once, strict=True):
                th.testing.assert_close(part, whole[step])
            starts = np.zeros(3, dtype=bool)


@pytest.mark.parametrize("continuous", [False, True])
def test_predict_carries_its_state_and_forgets_at_an_episodes_start(continuous):
    model = _model(env=Recall(continuous=continuous))
    obs = {"partial": np.random.default_rng(0).random((2, 4), dtype=np.float32)}
    first, state = model.predict(obs, deterministic=True)
    _, later_state = model.predict(obs, state, np.zeros(2, dtype=bool), deterministic=True)
    again, state_again = model.predict(obs, later_state, np.ones(2, dtype=bool), deterministic=True)
    assert not np.allclose(state[0], later_state[0])
    assert np.array_equal(first, again)
    assert np.allclose(state[0], state_again[0])
    single, state = model.predict({"partial": obs["partial"][0]}, deterministic=True)
    assert np.allclose(single, first[0])
    assert state[0].shape == (1, 8)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("continuous", [False, True])
def test_the_guider_carries_two_states(continuous, policy):
    """The learner's and its own, each as its network has it, and forgets both where an episode starts."""
    model = _model(policy=policy, env=Recall(continuous=continuous))
    unlike_each_other(model.policy)
    first, second = ({key: value[0].numpy() for key, value in _observations(1, 3).items()} for _ in range(2))
    begun, states = model.predict_guider(first, deterministic=True)
    assert begun.shape == ((3, 1) if continuous else (3,))
    assert [part.shape for part in states] == [(3, 16 if "Lstm" in policy else 8)] * 2
    _assert_states(states, _states_after(model.policy, [first]))
    went_on, later = model.predict_guider(second, states, np.array([False, True, False]), deterministic=True)
    expected = _states_after(model.policy, [first, second])
    for whole, started in zip(expected, _states_after(model.policy, [second]), strict=True):
        whole[1] = started[1]
    _assert_states(later, expected)
    if continuous:
        started, _ = model.predict_guider(second, deterministic=True)
        np.testing.assert_allclose(went_on[1], started[1], rtol=1e-4)
        assert (np.abs(went_on - started)[[0, 2]] > 1e-4).all()


def _behaving(policy):
    """Networks whose states the behaviour policy carries."""
    return [getattr(policy, name) for name in ("learner", "guider", "actor") if name in policy.roles.policies]


def _states_after(policy, observations):
    """What each network remembers of observations from an episode's start on, by one pass over all of them."""
    sequence = {key: th.as_tensor(np.stack([obs[key] for obs in observations])) for key in observations[0]}
    with th.no_grad():
        return [
            network.memory(network.extract_features(sequence, network.features_extractor))[1][0].numpy().copy()
            for network in _behaving(policy)
        ]


def _assert_states(actual, expected):
    for one, other in zip(actual, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_burn_in_brings_memories_up_and_counts_for_nothing():
    """Steps before the mask change the loss by what is remembered of them alone, not by their rewards."""
    model = _model(learning_starts=1000, replay_buffer_kwargs={"sequence_length": 2, "burn_in": 2}).learn(60)
    batch = model._sample_batch(64)
    assert (batch.mask[0] == 0).any()
    rewards = batch.rewards + 100 * (1 - batch.mask)
    critic = model.policy.learner_critic
    for changed, same in ((batch._replace(rewards=rewards), True), (_with_other_start(batch), False)):
        losses = [critic_loss_of(model, critic, one) for one in (batch, changed)]
        assert (losses[0] == pytest.approx(losses[1], rel=1e-6)) == same


def _with_other_start(batch):
    sequence = {key: value.clone() for key, value in batch.sequence.items()}
    sequence["partial"][0][batch.mask[0] == 0] += 1.0
    return batch._replace(sequence=sequence, observations={key: value[:-1] for key, value in sequence.items()})


def critic_loss_of(model, critic, batch):
    return model.bellman_loss("learner_critic", batch, batch.rewards).value.item()


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_the_deployed_policy_never_sees_what_is_privileged(cls):
    model = _model(cls).learn(80)
    sequence = {key: value.requires_grad_() for key, value in _observations(4, 2).items()}
    output = model.policy.deployed.distribution(sequence)[0].sum()
    gradients = th.autograd.grad(output, list(sequence.values()), allow_unused=True)
    assert gradients[0].abs().sum() > 0
    assert gradients[1] is None


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("cls", ALGORITHMS)
def test_saved_and_loaded_it_acts_and_goes_on_as_before(cls, policy, tmp_path):
    model = _model(cls, policy).learn(80)
    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=Recall())
    obs = {"partial": np.random.default_rng(0).random((16, 4), dtype=np.float32)}
    expected, state = model.predict(obs, deterministic=True)
    actual, state_loaded = loaded.predict(obs, deterministic=True)
    assert np.array_equal(actual, expected)
    assert np.allclose(state[0], state_loaded[0])
    model.save_replay_buffer(tmp_path / "buffer")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 100


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_equal_seeds_give_equal_results_with_several_environments(cls):
    def trained():
        model = _model(cls, env=make_vec_env(Recall, 3, seed=1)).learn(120)
        return th.cat([p.detach().flatten() for p in model.policy.parameters()])

    assert th.equal(trained(), trained())


def test_behind_vec_normalize():
    env = VecNormalize(make_vec_env(Recall, 2, seed=0), norm_obs_keys=["partial"])
    assert _model(env=env).learn(80)._n_updates > 0


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("cls", [GAC, GACShare, GACWithoutQ, AsymmetricSAC])
def test_while_collecting_the_memory_is_brought_up_and_forgets_with_each_episode(cls, policy):
    """After every step, in warm-up as well, each network remembers its episode so far, and nothing of the one before."""
    lengths = (3, 5)
    model = _model(cls, policy, DummyVecEnv([lambda n=n: Recall(n, continuous=True) for n in lengths]), learning_starts=8)
    unlike_each_other(model.policy)
    behave, steps = model.policy.behaviour_action, []

    def spy(observation, *args, **kwargs):
        action, state = behave(observation, *args, **kwargs)
        steps.append((observation, [part.copy() for part in state]))
        return action, state

    model.policy.behaviour_action = spy
    model.train = lambda *args, **kwargs: None  # the networks stay what they are
    model.learn(24)
    assert len(steps) == 12
    for env, length in enumerate(lengths):
        for step, (_, states) in enumerate(steps):
            so_far = [steps[before][0] for before in range(step - step % length, step + 1)]
            of_env = [{key: value[[env]] for key, value in obs.items()} for obs in so_far]
            _assert_states([part[[env]] for part in states], _states_after(model.policy, of_env))


def test_whole_episodes_can_be_the_unit_of_training():
    model = _model(train_freq=(1, "episode"), gradient_steps=3).learn(80)
    assert model._n_updates == 3 * (80 // 4 - 40 // 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"compile": True}, "compile=True can't do recurrent policies"),
        ({"n_steps": 3}, "n_steps must be 1 for a recurrent policy"),
        ({"replay_buffer_class": DictReplayBuffer}, "A recurrent policy learns from sequences"),
        ({"replay_buffer_class": CompactDictReplayBuffer}, "give EpisodeReplayBuffer or a subclass"),
    ],
)
def test_what_recurrent_policies_cannot_have(arguments, message):
    with pytest.raises(ValueError, match=message):
        _model(**arguments)


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_gradient_steps_wait_for_the_first_whole_episode_and_say_so_once(cls):
    model = _model(cls, env=Recall(length=8), learning_starts=2)
    with pytest.warns(UserWarning, match=r"no gradient steps until .* learning_starts=2") as warnings:
        model.learn(12)
    assert len([warning for warning in warnings if "no gradient steps" in str(warning.message)]) == 1
    assert model._n_updates == 12 - 7


def test_a_buffer_that_no_episode_fits_in_is_an_error():
    model = _model(env=Recall(length=20), learning_starts=2, buffer_size=10)
    with pytest.warns(UserWarning, match="no gradient steps"), pytest.raises(ValueError, match="buffer_size far above it"):
        model.learn(15)
    assert model.num_timesteps == 10


@pytest.mark.parametrize("done", [True, np.bool_(True), np.array(True)])
def test_a_single_environments_done_starts_an_episode(done):
    model = GAC("MultiInputGruPolicy", Recall(), policy_kwargs={"rnn_hidden_size": 8}, seed=0, device="cpu")
    observation, _ = Recall().reset(seed=0)
    first, state = model.predict(observation, deterministic=True)
    again, after = model.predict(observation, state, done, deterministic=True)
    assert np.array_equal(first, again)
    np.testing.assert_array_equal(after[0], state[0])
