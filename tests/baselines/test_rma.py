"""RMA: SAC with a latent of what is privileged, then an estimate of that latent, from the data of the actor that has it."""

import warnings
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac import RMA, TGRL, AsymmetricSAC, EpisodeReplayBuffer, OnnxPolicy, export_learner
from tests.helpers import Sampled, TwoViewBandit, TwoViewChoice, noise_of_step, small_model, unlike_each_other
from tests.plain.algorithm_1 import Coefficient, Gaussian
from tests.plain.replay import Recorded

FULL = ["partial", "privileged"]
VECTORS = spaces.Dict(partial=spaces.Box(-1, 1, (3,), np.float32), privileged=spaces.Box(-1, 1, (2,), np.float32))
IMAGES = spaces.Dict(partial=spaces.Box(0, 255, (3, 36, 36), np.uint8), privileged=VECTORS["privileged"])
SMALL = {"net_arch": [8], "encoder_net_arch": [8], "latent_dim": 3}


def make(env=None, **arguments):
    return small_model(env, RMA, **{"history": 3, "policy_kwargs": SMALL, **arguments})


def _numbers(module):
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def _changed(policy, before):
    """Which parts of the policy are not what they were: "adaptation", or the attribute's name."""
    names = [name for name, value in policy.state_dict().items() if not th.equal(value, before[name])]
    return {"adaptation" if name.startswith("actor.memory") else name.split(".")[0] for name in names}


def _steps_of(model, steps, **learn):
    """Learn, and write down who acted, in which phase, at each step."""
    seen = []
    model.on_step = lambda: seen.append((model.phase, *model.acting))
    model.learn(steps, **learn)
    del model.on_step
    return seen


# --- limits ---------------------------------------------------------------------------------------------------------------


class Whole(BaseFeaturesExtractor):
    """An encoder that leaves what it encodes as it is."""

    def __init__(self, extractor, net_arch, latent_dim, activation_fn):
        super().__init__(extractor._observation_space, extractor.features_dim)
        self.extractor = extractor

    def forward(self, observations):
        return self.extractor(observations)


@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
def test_with_the_true_z_phase_1_is_sac_on_the_full_state(env, monkeypatch):
    """From the same weights, to the bit: what is collected, and every parameter, the targets' as well."""
    monkeypatch.setattr("sb3_gac.baselines.rma.LatentExtractor", Whole)
    shared = {"learning_starts": 0, "gradient_steps": 2}
    rma = make(env(length=4), policy_kwargs={"net_arch": [16], "latent_dim": 1}, phase_1_steps=1000, **shared)
    sac = small_model(env(length=4), AsymmetricSAC, role_keys={"actor": FULL}, **shared)
    start = {name: value.clone() for name, value in rma.policy.state_dict().items() if name in sac.policy.state_dict()}
    sac.policy.load_state_dict(start)
    for model in (rma, sac):
        model.set_random_seed(3)
        model.learn(60)
    for name, value in sac.policy.state_dict().items():
        th.testing.assert_close(rma.policy.state_dict()[name], value, rtol=0, atol=0)
        assert not th.equal(value, start[name]), f"{name} stood still: nothing was tested"
    for name, rows in sac.replay_buffer.rows_by_name().items():
        np.testing.assert_array_equal(rma.replay_buffer.rows_by_name()[name], rows)
    assert rma.coefficients["ent_coef"].value == sac.coefficients["ent_coef"].value != 0.1


# --- golden numbers -------------------------------------------------------------------------------------------------------

RATE, GAMMA, TAU, BOUNDS = 0.01, 0.9, 0.1, (-1.2, 0.4)


class Plain:
    """Phase 1's gradient step as one would write it first, in float64, from a policy's numbers."""

    def __init__(self, policy):
        state = {name: value.detach().double().clone() for name, value in policy.state_dict().items()}
        encoder, of_target = "expert.features_extractor.extractors.1.", "critic_target.features_extractor.extractors.1."
        self.actor = {name: state[f"actor.{name}"].requires_grad_() for name in BODY}
        self.encoder = {name: state[encoder + name].requires_grad_() for name in ENCODER}
        self.critic = {name: state[f"critic.{name}"].requires_grad_() for name in CRITIC}
        self.encoder_target = {name: state[of_target + name] for name in ENCODER}
        self.critic_target = {name: state[f"critic_target.{name}"] for name in CRITIC}
        self.beta = Coefficient("ent_coef", "auto_0.3", RATE)

    @staticmethod
    def z(encoder, obs):
        hidden = th.nn.functional.silu(obs["privileged"] @ encoder["net.0.weight"].T + encoder["net.0.bias"])
        return th.tanh(hidden @ encoder["output.weight"].T + encoder["output.bias"])

    def policy(self, partial, z):
        p = self.actor
        x = th.nn.functional.silu(th.cat([partial, z], dim=-1) @ p["latent_net.0.weight"].T + p["latent_net.0.bias"])
        mean, log_std = (x @ p[f"head.{name}.weight"].T + p[f"head.{name}.bias"] for name in ("mean", "log_std"))
        return Gaussian(mean, log_std.clamp(*BOUNDS).exp())

    @staticmethod
    def q(p, partial, z, action):
        values = []
        for i in range(2):
            x = th.cat([partial, z], dim=-1) @ p["input.features_weight"][i] + action @ p["input.actions_weight"][i]
            hidden = th.nn.functional.silu(x + p["input.bias"][i])
            values.append((hidden * p["output.weight"][i]).sum(dim=-1) + p["output.bias"][i])
        return values

    def descend(self, loss, *groups):
        parameters = [parameter for group in groups for parameter in group.values()]
        with th.no_grad():
            for parameter, gradient in zip(parameters, th.autograd.grad(loss, parameters), strict=True):
                parameter -= RATE * gradient

    def step(self, obs, action, reward, next_obs, done, noise):
        beta = self.beta.value
        with th.no_grad():
            later = self.policy(next_obs["partial"], self.z(self.encoder, next_obs))
            z_later = self.z(self.encoder_target, next_obs)
            q, log_prob = later.value_and_log_prob(
                lambda a: self.q(self.critic_target, next_obs["partial"], z_later, a), noise[0]
            )
            y = reward + GAMMA * (1 - done) * (q - beta * log_prob)
        values = self.q(self.critic, obs["partial"], self.z(self.encoder, obs), action)
        critic_loss = sum(0.5 * (q - y).square().mean() for q in values)
        self.descend(critic_loss, self.critic, self.encoder)
        z = self.z(self.encoder, obs)
        q, log_prob = self.policy(obs["partial"], z).value_and_log_prob(
            lambda a: self.q(self.critic, obs["partial"], z.detach(), a), noise[1]
        )
        actor_loss = (beta * log_prob - q).mean()
        self.descend(actor_loss, self.actor, self.encoder)
        self.beta.update(log_prob.mean() - 0.7)
        for follows, leads in ((self.critic_target, self.critic), (self.encoder_target, self.encoder)):
            for name, value in follows.items():
                value += TAU * (leads[name].detach() - value)
        return critic_loss.item(), actor_loss.item(), -log_prob.mean().item()


BODY = [
    "latent_net.0.weight",
    "latent_net.0.bias",
    *(f"head.{a}.{b}" for a in ("mean", "log_std") for b in ("weight", "bias")),
]
ENCODER = ["net.0.weight", "net.0.bias", "output.weight", "output.bias"]
CRITIC = [*(f"input.{name}" for name in ("features_weight", "actions_weight", "bias")), "output.weight", "output.bias"]


def _recorded(**arguments):
    """With two environments' steps in its replay buffer, plain gradient descent, and weights unlike each other."""
    kwargs = {"optimizer_class": th.optim.SGD, "log_std_bounds": BOUNDS, **SMALL}
    env = DummyVecEnv([Recorded, Recorded])
    shared = {"learning_rate": RATE, "gamma": GAMMA, "tau": TAU, "ent_coef": "auto_0.3", "target_entropy": -0.7}
    model = make(env, policy_kwargs=kwargs, learning_starts=1000, max_grad_norm=None, **shared, **arguments).learn(80)
    unlike_each_other(model.policy)
    return model


def test_a_gradient_step_of_phase_1_is_the_plain_one():
    model = _recorded()
    plain, buffer = Plain(model.policy), model.replay_buffer
    before = _numbers(model.policy)
    for seed in range(4):
        np.random.seed(seed)
        samples = buffer.sample(16)
        np.random.seed(seed)
        th.manual_seed(seed)
        model.train(1, 16)
        obs, next_obs = ({key: value.double() for key, value in one.items()} for one in (samples[0], samples[2]))
        noise = noise_of_step(seed, 2, samples.actions.shape).double()
        rewards, dones = (values.double().flatten() for values in (samples.rewards, samples.dones))
        expected = plain.step(obs, samples.actions.double(), rewards, next_obs, dones, noise)
        logged = [model.logger.name_to_value[f"train/{name}"] for name in ("critic_loss", "actor_loss", "entropy")]
        assert logged == pytest.approx(list(expected), rel=1e-3, abs=1e-5)
    assert _changed(model.policy, before) == {"actor", "expert", "critic", "critic_target"}
    now, encoder = _numbers(model.policy), "features_extractor.extractors.1."
    groups = {
        "actor.": plain.actor,
        "critic.": plain.critic,
        f"expert.{encoder}": plain.encoder,
        "critic_target.": plain.critic_target,
        f"critic_target.{encoder}": plain.encoder_target,
    }
    for prefix, group in groups.items():
        for name, value in group.items():
            np.testing.assert_allclose(now[prefix + name], value.detach(), rtol=1e-4, atol=5e-6, err_msg=prefix + name)
            assert not th.allclose(now[prefix + name], before[prefix + name], atol=1e-5), f"{prefix}{name} stood still"
    actor, expert, critic = model.policy.actor, model.policy.expert, model.policy.critic
    assert expert.latent_net is actor.latent_net
    assert expert.head is actor.head
    assert expert.features_extractor.extractors[-1] is critic.features_extractor.extractors[-1]
    assert model.coefficients["ent_coef"].value.item() == pytest.approx(plain.beta.value.item(), rel=1e-5)


def test_a_gradient_step_of_phase_2_is_the_plain_regression():
    """By finite differences of the mean squared error, for some numbers of each layer."""
    model = _recorded(history=6)
    model.phase = 2
    policy, module, before = model.policy, deepcopy(model.policy.adaptation).double(), _numbers(model.policy)
    plain = Plain(policy)
    np.random.seed(0)
    samples, histories = model.replay_buffer.sample_with_histories(16, 6)
    z = Plain.z(plain.encoder, {key: value.double() for key, value in samples.observations.items()}).detach()
    pairs = th.cat([histories.observations["partial"], histories.actions], dim=-1).double()
    assert 0.2 < histories.mask.mean() < 0.9

    @th.no_grad()
    def error():
        estimates = [module.output(_plain_features(module, pairs[:, i])) for i in range(16)]
        return sum((estimate - own).square().sum() for estimate, own in zip(estimates, z, strict=True)).item() / z.numel()

    np.random.seed(0)
    model.train(1, 16)
    assert model.logger.name_to_value["train/adaptation_loss"] == pytest.approx(error(), rel=1e-4)
    assert _changed(policy, before) == {"adaptation"}
    for name, parameter in module.named_parameters():
        index = (0,) * parameter.dim()
        values = []
        for sign in (1, -1):
            parameter.data[index] += sign * 1e-5
            values.append(error())
            parameter.data[index] -= sign * 1e-5
        gradient = (values[0] - values[1]) / 2e-5
        moved = (dict(policy.adaptation.named_parameters())[name][index] - before[f"actor.memory.{name}"][index]).item()
        assert moved == pytest.approx(-RATE * gradient, rel=0.02, abs=2e-6), name


def _plain_features(module, pairs):
    """Of one history, shape (K, F + A), up to the last layer."""
    x = pairs
    for layer in module.per_pair:
        x = layer(x)
    for layer in module.over_time:
        if isinstance(layer, th.nn.Conv1d):
            windows = x.unfold(0, layer.kernel_size[0], layer.stride[0])  # (T, channels, kernel size)
            x = (windows[:, None] * layer.weight).sum(dim=(2, 3)) + layer.bias
        else:
            x = th.nn.functional.silu(x)
    return x.T.flatten()


# --- phases ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("given", "ends"), [(None, 30), (24, 24)])
def test_the_expert_collects_and_from_phase_2_on_the_actor(given, ends):
    model = make(TwoViewBandit(length=7), phase_1_steps=given)
    seen = _steps_of(model, 60)
    assert seen == [(1, "expert")] * ends + [(2, "actor")] * (60 - ends), "in the middle of an episode"
    assert model.policy.roles.behaviour == "expert"


def test_a_training_that_ends_in_phase_1_is_warned_of():
    model = make(TwoViewBandit(length=7), phase_1_steps=30)
    with pytest.warns(
        UserWarning, match="RMA ends in phase 1, because phase_1_steps is 30 and training ends after 30 steps"
    ) as told:
        model.learn(30)
    assert [warning.filename for warning in told] == [__file__]
    assert model.phase == 1
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "RMA ends")
        model.learn(31)
        model.learn(5, reset_num_timesteps=False)
        make(TwoViewBandit(length=7)).learn(30)
    assert model.phase == 2


def test_the_share_is_that_of_the_learn_that_began_to_count():
    model = make(TwoViewBandit(length=7))
    assert _steps_of(model, 40)[-1] == (2, "actor")
    assert {phase for phase, _ in _steps_of(model, 100, reset_num_timesteps=False)} == {2}
    assert _steps_of(model, 60) == [(1, "expert")] * 30 + [(2, "actor")] * 30, "both once more"
    interrupted = make(TwoViewBandit(length=7))
    assert _steps_of(interrupted, 100, callback=lambda locals_, globals_: interrupted.num_timesteps < 20)[-1][0] == 1
    rest = _steps_of(interrupted, 80, reset_num_timesteps=False)
    assert [phase for phase, _ in rest] == [1] * 30 + [2] * 50


def test_phase_1_lasts_to_the_end_of_the_warm_up():
    model = make(TwoViewBandit(length=7), learning_starts=25)
    assert [phase for phase, _ in _steps_of(model, 40)] == [1] * 25 + [2] * 15


def test_whoever_is_told_to_collect_does():
    model = make(TwoViewBandit(length=7), behaviour="expert")
    assert _steps_of(model, 40) == [(1, "expert")] * 20 + [(2, "expert")] * 20


def test_in_phase_1_all_but_the_estimate_is_trained_and_in_phase_2_the_estimate_alone():
    """To the bit, targets and what optimisers keep included."""
    model = make(DummyVecEnv([lambda: TwoViewBandit(length=7)] * 2))
    of_adaptation, rows = _numbers(model.policy.adaptation), {}
    model.choose_acting, choose = (
        lambda starts: (rows.setdefault(model.phase, _saved(model)), choose(starts))[1],
        model.choose_acting,
    )
    model.learn(80)
    at_the_end_of_phase_1, at_the_end = rows[2], _saved(model)
    for name, before in _numbers(model.policy.adaptation).items():
        assert not th.equal(before, of_adaptation[name])
        assert th.equal(rows[1]["policy"][f"actor.memory.{name}"], of_adaptation[name])
    for name, value in at_the_end["policy"].items():
        assert name.startswith("actor.memory") or th.equal(value, at_the_end_of_phase_1["policy"][name]), name
    for name in ("actor", "expert", "critic"):
        states = [saved[f"policy.{name}.optimizer"]["state"] for saved in (at_the_end_of_phase_1, at_the_end)]
        th.testing.assert_close(*states, rtol=0, atol=0)


def _saved(model):
    return deepcopy(model.get_parameters())


def test_the_estimate_is_fitted_on_data_of_the_actor_alone():
    """With what came before, phase 1 included."""
    model = make(TwoViewBandit(length=100), phase_1_steps=30)
    drawn = []
    sample = model.replay_buffer.sample_with_histories
    model.replay_buffer.sample_with_histories = lambda *args, **kwargs: drawn.append(sample(*args, **kwargs)) or drawn[-1]
    model.learn(40)
    acted = {float(row) for row in model.replay_buffer.observations["privileged"][30:40].ravel()}
    seen = {float(x) for samples, _ in drawn for x in samples.observations["privileged"].flatten()}
    assert seen <= acted
    assert len(seen) > 5
    assert all(histories.mask.all() for _, histories in drawn)


def test_metrics_of_each_phase_are_logged():
    model = make(TwoViewBandit(length=7))
    model.learn(19, reset_num_timesteps=False)  # half is 9, the warm-up 10
    assert model.phase == 2
    logged = {name for name in model.logger.name_to_value if name.startswith("train/")}
    assert {"train/adaptation_loss", "train/adaptation_grad_norm"} <= logged
    model = make(TwoViewBandit(length=7), phase_1_steps=100).learn(20)
    logged = {name for name in model.logger.name_to_value if name.startswith("train/")}
    assert {f"train/{name}" for name in ("actor_loss", "critic_loss", "expert_grad_norm", "ent_coef", "entropy")} <= logged
    assert "train/adaptation_loss" not in logged


# --- what acts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
@pytest.mark.parametrize("noise", [False, True])
def test_the_actor_remembers_what_the_replay_buffer_holds(env, noise):
    """Through the warm-up, both phases, action noise and episodes' ends, in environments out of step."""
    noise = NormalActionNoise(np.zeros(1), np.full(1, 0.3)) if noise and env is TwoViewBandit else None
    model = make(DummyVecEnv([lambda n=n: env(length=n) for n in (4, 9)]), history=5, action_noise=noise, learning_starts=8)
    compared = []

    def compare():
        buffer, newest = model.replay_buffer, model.replay_buffer.n_added
        histories = buffer._histories(np.full(2, newest), np.arange(2), 5, None)
        policy = model.policy
        with th.no_grad():
            features = policy.actor.extract_features(histories.observations, policy.actor.features_extractor)
            expected = policy.adaptation.state_of(features, histories.actions, histories.mask).numpy()
        goes_on = ~model._last_episode_starts
        np.testing.assert_array_equal(model._behaviour_state[0][goes_on], expected[goes_on])
        compared.append(histories.mask.sum().item())

    model.on_step = compare
    model.learn(80)
    assert max(compared) > 5


def test_predict_carries_its_observations_and_actions_and_forgets_them_at_an_episodes_start():
    model = make(TwoViewBandit(length=7), history=2).learn(40)
    policy, rng = model.policy, np.random.default_rng(0)
    seen, taken, state = rng.standard_normal((4, 1, 2)).astype(np.float32), [], None
    for step, partial in enumerate(seen):
        before = [np.concatenate([seen[i][0], taken[i]]) if i >= 0 else np.zeros(3) for i in (step - 2, step - 1)]
        action, state = model.predict({"partial": partial}, state, deterministic=True)
        with th.no_grad():
            z = policy.adaptation.estimate(th.as_tensor(np.concatenate(before), dtype=th.float32)[None])
            latent = policy.actor.latent_net(th.cat([th.as_tensor(partial), z], dim=-1))
            np.testing.assert_allclose(action, policy.actor.head(latent).mode, rtol=1e-5, atol=1e-6)
        taken.append(action[0])
        np.testing.assert_allclose(state[0][0, -3:], np.concatenate([partial[0], action[0]]), rtol=1e-6)
    first, _ = model.predict({"partial": seen[0]}, deterministic=True)
    again, _ = model.predict({"partial": seen[0]}, state, np.array([True]), deterministic=True)
    on, _ = model.predict({"partial": seen[0]}, state, np.array([False]), deterministic=True)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, on)


def test_actions_in_other_ranges_are_remembered_as_they_are_trained_on():
    class Wide(TwoViewBandit):
        def __init__(self):
            super().__init__(length=7)
            self.action_space = spaces.Box(np.array([[-4.0, 0.0]], np.float32), np.array([[4.0, 10.0]], np.float32))

        def step(self, action):
            return super().step(np.ravel(action))

    model = make(Wide()).learn(40)
    action, (state,) = model.predict({"partial": np.zeros((1, 2), np.float32)}, deterministic=True)
    assert action.shape == (1, 1, 2)
    np.testing.assert_allclose(state[0, -2:], [action[0, 0, 0] / 4, action[0, 0, 1] / 5 - 1], atol=1e-6)


def test_before_phase_2_predict_acts_with_an_estimate_that_was_never_trained():
    model = make(phase_1_steps=100).learn(12)
    assert model.phase == 1
    action, (state,) = model.predict({"partial": np.ones(2, np.float32)}, deterministic=True)
    assert action.shape == (1,)
    assert state.shape == (1, 9)


# --- who sees what --------------------------------------------------------------------------------------------------------


def _reads(model, function):
    obs = {key: th.randn(6, *space.shape, requires_grad=True) for key, space in model.observation_space.items()}
    gradients = th.autograd.grad(function(obs).sum(), list(obs.values()), allow_unused=True)
    return {key for key, gradient in zip(obs, gradients, strict=True) if gradient is not None and gradient.any()}


@pytest.mark.parametrize(
    ("role_keys", "actor", "expert", "critic"),
    [
        (None, {"a"}, {"a", "b", "c"}, {"a", "b", "c"}),
        ({"expert": ["b"]}, {"a"}, {"a", "b"}, {"a", "b"}),
        ({"critic": ["c"], "expert": ["a", "b"]}, {"a"}, {"a", "b"}, {"b", "c"}),
        ({"actor": ["a", "c"]}, {"a", "c"}, {"a", "b", "c"}, {"a", "b", "c"}),
    ],
)
def test_roles_read_their_entries_and_what_is_encoded(role_keys, actor, expert, critic):
    names = {"a": "partial", "b": "privileged", "c": "forces"}
    space = spaces.Dict({name: spaces.Box(-1, 1, (2,), np.float32) for name in names.values()})
    keys = {role: [names[letter] for letter in letters] for role, letters in (role_keys or {}).items()}
    policy = (model := make(Sampled(space), role_keys=keys or None)).policy
    expected = [{names[letter] for letter in letters} for letters in (actor, expert, critic)]
    one_step = {"actor": lambda obs: policy.actor.distribution({key: value[None] for key, value in obs.items()}).mean}
    assert _reads(model, one_step["actor"]) == expected[0]
    assert _reads(model, lambda obs: policy.expert.distribution(obs).mean) == expected[1]
    assert _reads(model, lambda obs: policy.critic(obs, th.zeros(6, 1))) == expected[2]
    assert set(policy.role_keys["critic"]) == expected[2]


def test_the_expert_is_the_actor_with_the_true_z_and_the_encoder_is_the_critics():
    policy = make().policy
    own = {name: {id(p) for p in trained.everything} for name, trained in policy.trained.items()}
    assert sum(map(len, own.values())) == len(set().union(*own.values())), "each parameter has one optimiser"
    assert own["adaptation"] == {id(p) for p in policy.actor.memory.parameters()}
    assert own["expert"] == {id(p) for p in policy.critic.features_extractor.extractors[-1].parameters()}
    assert own["actor"] == {id(p) for part in (policy.actor.latent_net, policy.actor.head) for p in part.parameters()}
    targets = {id(p) for p in policy.critic_target.parameters()}
    assert not targets & set().union(*own.values())
    widths = [policy.critic.input.features_weight.shape[1], policy.expert.features_extractor.features_dim]
    assert widths == [2 + 3, 2 + 3], "z in place of what is encoded"
    obs = {"partial": th.randn(5, 2), "privileged": th.randn(5, 1)}
    z = policy.expert.extract_features(obs, policy.expert.features_extractor)[:, 2:]
    assert z.shape == (5, 3)
    assert z.abs().max() < 1
    expected = policy.actor.head(policy.actor.latent_net(th.cat([obs["partial"], z], dim=-1)))
    assert all(th.equal(one, other) for one, other in zip(policy.expert.distribution(obs), expected, strict=True))


def test_what_is_learned_on_images_is_learned_by_the_actors_encoder_too():
    """By the actor's loss, in phase 1; the history is of its features."""
    kwargs = SMALL | {"features_extractor_kwargs": {"cnn_output_dim": 8}}
    model = make(Sampled(IMAGES), history=2, policy_kwargs=kwargs, batch_size=4, learning_starts=5)
    before = _numbers(model.policy.actor.features_extractor)
    model.learn(20)
    assert model.phase == 2
    assert all(not th.equal(value, before[name]) for name, value in _numbers(model.policy.actor.features_extractor).items())
    _, (state,) = model.predict({"partial": IMAGES["partial"].sample()})
    assert state.shape == (1, 2 * (8 + 1))


# --- promises -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1, 50])
@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
@pytest.mark.parametrize("suffix", [".onnx", ".pt"])
def test_the_file_acts_as_predict_does_and_remembers_its_own_actions(env, length, suffix, tmp_path):
    model = make(env(length=7), history=length).learn(40)
    unlike_each_other(model.policy)
    path = export_learner(model, tmp_path / f"robot{suffix}", verify_on=8)
    seen, state = np.random.default_rng(0).standard_normal((60, 3, 2)).astype(np.float32), None
    act = OnnxPolicy.load(path).act if suffix == ".onnx" else _scripted(path, model)
    for partial in seen:
        expected, state = model.predict({"partial": partial}, state, deterministic=True)
        np.testing.assert_allclose(act(partial), expected, atol=1e-5)


def _scripted(path, model):
    module, state = th.jit.load(str(path)), [th.zeros(3, model.policy.adaptation.state_size)]

    def act(partial):
        action, state[0] = module(th.as_tensor(partial), state[0])
        return action.numpy()

    return act


def test_saved_and_loaded_it_goes_on_in_its_phase(tmp_path):
    model = make(TwoViewBandit(length=7)).learn(40)
    model.save(tmp_path / "model")
    loaded = RMA.load(tmp_path / "model", env=TwoViewBandit(length=7))
    assert (loaded.phase, loaded.half_of_the_steps) == (2, 20)
    before = _numbers(loaded.policy)
    assert _steps_of(loaded, 20, reset_num_timesteps=False) == [(2, "actor")] * 20
    assert _changed(loaded.policy, before) == {"adaptation"}
    longer = RMA.load(tmp_path / "model", env=TwoViewBandit(length=7), phase_1_steps=50)
    assert [phase for phase, _ in _steps_of(longer, 20, reset_num_timesteps=False)] == [1] * 10 + [2] * 10
    partial = {"partial": np.ones(2, np.float32)}
    np.testing.assert_array_equal(
        *(RMA.load(tmp_path / "model").predict(partial, deterministic=True)[0], model.predict(partial, deterministic=True)[0])
    )


def test_two_environments_and_episodes_of_replay_train_as_well():
    model = make(DummyVecEnv([lambda: TwoViewBandit(length=4)] * 2), replay_buffer_class=EpisodeReplayBuffer, batch_size=4)
    before = _numbers(model.policy)
    model.learn(80)
    assert model.phase == 2
    assert _changed(model.policy, before) == {"actor", "expert", "critic", "critic_target", "adaptation"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"history": 0}, "history must be"),
        ({"phase_1_steps": 0}, "phase_1_steps must be .* or None for half of the steps"),
        ({"phase_1_steps": 10}, "phase_1_steps must be above learning_starts=10, got 10"),
        ({"policy_kwargs": {"latent_dim": 0}}, "latent_dim must be"),
        ({"policy_kwargs": {"rnn_type": {"critic": "gru"}}}, "leave rnn_type and share_features_extractor out"),
        ({"policy_kwargs": {"share_features_extractor": True}}, "leave rnn_type and share_features_extractor out"),
        ({"replay_buffer_class": DictReplayBuffer}, "replay_buffer_class=DictReplayBuffer can't sample what came before"),
        ({"role_keys": {"actor": FULL}}, "RMA encodes entries that its actor does not read, but there are none"),
        ({"role_keys": {"adaptation": ["partial"]}}, r"role_keys names unknown roles \['adaptation'\]"),
        ({"lr_scales": {"encoder": 2.0}}, r"the roles are \['actor', 'expert', 'critic', 'adaptation', 'memory'\]"),
        ({"policy": "MultiInputGruPolicy"}, "policy must be one of"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_a_model_of_it_cannot_teach():
    """Its deployed policy has a memory."""
    with pytest.raises(ValueError, match="teacher has a memory"):
        small_model(cls=TGRL, teacher=make())


def test_networks_rest_and_have_rates_by_role():
    model = make(TwoViewBandit(length=7), lr_scales={"adaptation": 0.5}, update_every={"adaptation": 1000}, phase_1_steps=20)
    assert model.policy.adaptation.optimizer.param_groups[0]["lr_scale"] == 0.5
    model._n_updates = 1
    before = _numbers(model.policy.adaptation)
    model.learn(40)
    assert all(th.equal(value, before[name]) for name, value in _numbers(model.policy.adaptation).items())


def _encoder_and_others(model):
    encoder = model.policy.critic.features_extractor.extractors[-1]
    return {
        "encoder": encoder.output.weight,
        "critic": model.policy.critic.output.weight,
        "actor": model.policy.actor.head.mean.weight,
    }


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({}, {"encoder": [0, 1, 2, 3], "critic": [0, 1, 2, 3], "actor": [0, 1, 2, 3]}),
        ({"policy_delay": 3}, {"encoder": [0, 1, 2, 3], "critic": [0, 1, 2, 3], "actor": [0, 3]}),
        ({"update_every": {"critic": 2}, "policy_delay": 3}, {"encoder": [0, 2, 3], "critic": [0, 2], "actor": [0, 3]}),
        ({"update_every": {"expert": 2}}, {"encoder": [0, 2], "critic": [0, 1, 2, 3], "actor": [0, 1, 2, 3]}),
    ],
)
def test_the_encoder_learns_with_the_critics_and_with_the_actor(arguments, expected):
    model = make(TwoViewBandit(length=7), phase_1_steps=10_000, learning_starts=1000, **arguments)
    model.learn(40)
    moved = {name: [] for name in expected}
    for step in range(4):
        before = {name: value.detach().clone() for name, value in _encoder_and_others(model).items()}
        model.train(1, 8)
        for name, value in _encoder_and_others(model).items():
            moved[name] += [] if th.equal(value, before[name]) else [step]
    assert moved == expected


def test_an_episode_under_way_when_phase_2_begins_is_no_policys():
    model, told = make(TwoViewBandit(length=7), phase_1_steps=17, learning_starts=5), []
    model.on_episode_end = lambda env, episode_return, role: told.append(role)
    model.learn(28)
    assert told == [None, "expert", None, "actor"], "the first has steps of the warm-up"


# --- it learns ------------------------------------------------------------------------------------------------------------


class HiddenPush(gym.Env):
    """
    Two tasks: throughout an episode something pushes to the left, or to the right. ``privileged`` says which, ``partial``
    shows what the last action and the push came to. Return: minus the squared distance of that from 0.
    """

    def __init__(self):
        self.observation_space = spaces.Dict(
            partial=spaces.Box(-2, 2, (1,), np.float32), privileged=spaces.Box(-1, 1, (1,), np.float32)
        )
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._push, self._steps = self.np_random.choice([-0.5, 0.5]), 0
        return self._views(0.0), {}

    def step(self, action):
        came_to = self._push + float(action[0])
        self._steps += 1
        return self._views(came_to), -(came_to**2), False, self._steps == 6, {}

    def _views(self, came_to):
        return {"partial": np.array([came_to], np.float32), "privileged": np.array([2 * self._push], np.float32)}


def test_the_actor_finds_out_what_it_is_not_told():
    """From the third step on it knows the push, by what its first action came to, and does what is best against it."""
    arguments = {"learning_rate": 3e-3, "batch_size": 64, "gamma": 0.0, "ent_coef": 0.003, "learning_starts": 100}
    model = make(HiddenPush(), policy_kwargs=SMALL | {"net_arch": [32]}, phase_1_steps=700, **arguments)
    model.learn(1100)
    for push in (-0.5, 0.5):
        came_to, state = 0.0, None
        for _ in range(5):
            action, state = model.predict({"partial": np.array([came_to], np.float32)}, state, deterministic=True)
            came_to = push + action[0]
        assert action[0] == pytest.approx(-push, abs=0.2), "the optimum; who knows nothing does nothing"
