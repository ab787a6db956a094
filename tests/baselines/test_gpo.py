"""GPO: its objectives by hand and in float64, PPO as its limit, rollouts that are gone on with, and its promises."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_gac import GPOClip, GPOPenalty, InvalidStepError, OnnxPolicy, export_learner
from sb3_gac.base.rollouts import UnrolledBuffer
from sb3_gac.math.losses import clipped_surrogate
from sb3_gac.optim.coefficients import MultiplicativeCoefficient
from tests.helpers import Sampled, TwoViewBandit, TwoViewChoice

BOTH = [GPOClip, GPOPenalty]
OF_POLICY = {"net_arch": [8, 8], "activation_fn": nn.SiLU}
LOSSES = ("loss", "guider_loss", "learner_loss", "actor_loss", "critic_loss", "entropy")


def make_model(env=None, cls=GPOClip, **arguments):
    arguments = {"n_steps": 16, "batch_size": 8, "n_epochs": 2, "learning_rate": 3e-3, "policy_kwargs": OF_POLICY} | arguments
    return cls("MultiInputPolicy", TwoViewBandit(length=3) if env is None else env, seed=0, device="cpu", **arguments)


def _same(one, other):
    return all(th.equal(p, q) for p, q in zip(one.policy.parameters(), other.policy.parameters(), strict=True))


# --- by hand ---------------------------------------------------------------------------------------------------------------


def _buffer(unroll_length=None, **arguments):
    space = spaces.Dict(partial=spaces.Box(-1, 1, (1,)))
    return UnrolledBuffer(4, space, spaces.Box(-1, 1, (1,)), "cpu", unroll_length=unroll_length, **arguments)


def test_advantages_by_hand():
    """gamma 1/2, lambda 1/2: deltas 1 + 1/2 2 - 1 = 1, 1 + 1/2 1 - 2 = -1/2, 1 - 1 = 0 (an end), 1 + 1/2 4 - 3 = 0."""
    buffer = _buffer(gamma=0.5, gae_lambda=0.5)
    for value, starts in zip([1.0, 2.0, 1.0, 3.0], [1, 0, 0, 1], strict=True):
        buffer.add(
            {"partial": np.zeros((1, 1))}, np.zeros((1, 1)), np.ones(1), np.array([starts]), th.tensor([value]), th.zeros(1)
        )
    buffer.compute_returns_and_advantage(th.tensor([4.0]), np.array([False]))
    np.testing.assert_allclose(buffer.advantages[:, 0], [1 - 0.25 * 0.5, -0.5, 0, 0])
    np.testing.assert_allclose(buffer.returns, buffer.advantages + buffer.values)


@pytest.mark.parametrize("unroll_length", [None, 1, 3, 4, 9])
def test_advantages_look_ahead_to_the_end_of_their_unroll(unroll_length):
    rng = np.random.default_rng(0)
    buffer = _buffer(unroll_length, gamma=0.9, gae_lambda=0.8, n_envs=2)
    rewards, values = rng.normal(size=(4, 2)), rng.normal(size=(5, 2))
    starts = np.array([[1, 0], [0, 0], [0, 1], [0, 0], [1, 0]])
    for step in range(4):
        obs = {"partial": np.zeros((2, 1))}
        buffer.add(obs, np.zeros((2, 1)), rewards[step], starts[step], th.tensor(values[step]), th.zeros(2))
    buffer.compute_returns_and_advantage(th.tensor(values[4]), starts[4].astype(bool))
    expected = np.zeros((4, 2))
    for env in range(2):
        for step in range(4):
            weight = 1.0
            for later in range(step, 4):
                goes_on = 1 - starts[later + 1, env]
                delta = rewards[later, env] + 0.9 * goes_on * values[later + 1, env] - values[later, env]
                expected[step, env] += weight * delta
                if not goes_on or (unroll_length and (later + 1) % unroll_length == 0):
                    break
                weight *= 0.9 * 0.8
    np.testing.assert_allclose(buffer.advantages, expected, rtol=1e-5, atol=1e-6)


def test_the_clipped_surrogate_by_hand():
    """Ratios 2, 2, 1/2, 1/2 with advantages 1, -1, 1, -1 and epsilon 1/4: 1.25, -2, 0.5, -0.75 count."""
    log_ratio = th.tensor([2.0, 2.0, 0.5, 0.5]).log()
    loss = clipped_surrogate(log_ratio, th.tensor([1.0, -1.0, 1.0, -1.0]), th.tensor(0.25))
    assert loss.item() == pytest.approx(-(1.25 - 2 + 0.5 - 0.75) / 4)
    with pytest.raises(ValueError, match="advantages must have the shape"):
        clipped_surrogate(log_ratio, th.ones(4, 1), th.tensor(0.25))


def test_the_weight_of_the_kl_starts_at_nought_and_moves_by_a_factor():
    coefficient = MultiplicativeCoefficient(0.1, 1.2, 0.15, th.device("cpu"))
    seen = []
    for up in (False, True, True, False, True, True, True, True):
        coefficient.move(th.tensor(up))
        seen.append(coefficient.value.item())
    assert seen == pytest.approx([0, 0.1, 0.12, 0.1, 0.12, 0.144, 0.15, 0.15])
    assert coefficient.at_bound() == 1


def test_a_weight_of_the_kl_that_fell_to_nothing_rises_at_once():
    """In float32 it would be stuck near 1e-45 after 555 falls, where a fifth more of it is as much as before."""
    coefficient = MultiplicativeCoefficient(0.1, 1.2, 1.0, th.device("cpu"))
    coefficient.move(th.tensor(True))
    seen = []
    for _ in range(700):
        coefficient.move(th.tensor(False))
        seen.append(coefficient.value.item())
    assert seen[74] == pytest.approx(0.1 / 1.2**75)
    assert seen[76:] == [0.0] * 624, "from a millionth of its first value on"
    coefficient.move(th.tensor(True))
    assert coefficient.value.item() == pytest.approx(0.1)


# --- in float64 ------------------------------------------------------------------------------------------------------------


class PlainGPO:
    """The paper's one network, [privileged, partial, is_learner] -> 8 -> 8 -> mean and log std, and its value; in float64."""

    def __init__(self, model, delta=None, kl_coef=None):
        self.model, self.delta, self.kl_coef = model, delta, kl_coef
        learner, value = model.policy.learner, model.policy.critic.value_net
        entering = [model.policy.guider.privileged.weight, learner.latent_net[0].weight, learner.is_learner[:, None]]
        self.named = {"w1": th.cat(entering, dim=1), "b1": learner.latent_net[0].bias}
        self.named |= {"w2": learner.latent_net[2].weight, "b2": learner.latent_net[2].bias}
        self.named |= {name.replace(".", "_"): p for name, p in learner.head.named_parameters()}
        self.named |= {f"v_{name.replace('.', '_')}": p for name, p in value.named_parameters()}
        self.named = {name: p.detach().double().clone().requires_grad_() for name, p in self.named.items()}
        self.low, self.high = model.policy.learner.log_std_bounds

    def policy(self, privileged, partial, is_learner):
        n = self.named
        x = th.cat([privileged, partial, th.full((len(partial), 1), float(is_learner), dtype=th.float64)], dim=1)
        h = nn.functional.silu(nn.functional.silu(x @ n["w1"].T + n["b1"]) @ n["w2"].T + n["b2"])
        mean, log_std = (h @ n[f"{name}_weight"].T + n[f"{name}_bias"] for name in ("mean", "log_std"))
        return mean, log_std.clamp(self.low, self.high)

    def value(self, privileged, partial):
        n = self.named
        x = th.cat([partial, privileged], dim=1)
        for layer in (0, 2):
            x = nn.functional.silu(x @ n[f"v_{layer}_weight"].T + n[f"v_{layer}_bias"])
        return (x @ n["v_4_weight"].T + n["v_4_bias"])[:, 0]

    @staticmethod
    def log_prob(policy, drawn):
        mean, log_std = policy
        normal = th.distributions.Normal(mean, log_std.exp()).log_prob(drawn)
        return (normal - th.log(1 - th.tanh(drawn) ** 2)).sum(dim=1)

    @staticmethod
    def kl(one, other):
        both = [th.distributions.Normal(mean, log_std.exp()) for mean, log_std in (one, other)]
        return th.distributions.kl_divergence(*both).mean(dim=1)

    def loss(self, batch, noise, epsilon):
        """As in the paper: guider, learner, value, entropy."""
        s, o = (batch.observations[key].double() for key in ("privileged", "partial"))
        a, old, returns = (x.double() for x in (batch.actions, batch.old_log_prob, batch.returns))
        adv = batch.advantages.double()
        adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        guider, learner = self.policy(s, o, 0), self.policy(th.zeros_like(s), o, 1)
        fixed_guider, fixed_learner = (tuple(x.detach() for x in policy) for policy in (guider, learner))
        mu, pi, b = self.log_prob(guider, a).exp(), self.log_prob(learner, a).exp(), old.exp()
        if self.kl_coef is None:
            near = pi.detach() * (mu / pi.detach()).clamp(1 - self.delta, 1 + self.delta)
            left = ((mu / pi) < 1 - self.delta) | ((mu / pi) > 1 + self.delta)
            penalty = (left * self.kl(guider, fixed_learner)).mean()
        else:
            near, penalty = mu, self.kl_coef * self.kl(guider, fixed_learner).mean()
        of_guider = -th.min(mu / b * adv, (near / b).clamp(1 - epsilon, 1 + epsilon) * adv).mean() + penalty
        ratio = (pi / b).clamp(max=math.exp(10))
        of_learner = -th.min(ratio * adv, ratio.clamp(1 - epsilon, 1 + epsilon) * adv).mean()
        mean, log_std = guider
        entropy = -self.log_prob(guider, mean + log_std.exp() * noise.double()).mean()
        imitation = self.kl(fixed_guider, learner).mean()
        value = (self.value(s, o) - returns).square().mean()
        model = self.model
        return of_guider + imitation + model.learner_rl_coef * of_learner - model.ent_coef * entropy + model.vf_coef * value


def _apart(model):
    """So that guider, learner and the policy that collected are three different ones."""
    generator = th.Generator().manual_seed(3)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.3 * th.randn(parameter.shape, generator=generator))


@pytest.mark.parametrize("cls", BOTH)
def test_a_gradient_step_is_that_of_the_papers_one_network(cls):
    """The gradient by each parameter, from distinct policies."""
    model = make_model(cls=cls, ent_coef=0.01, max_grad_norm=None, learner_rl_coef=1.5, n_steps=64, batch_size=64)
    model.learn(64)
    model.rollout_buffer.generator_ready = True
    _apart(model)
    if cls is GPOPenalty:
        model.coefficients["kl_coef"].value.fill_(0.7)
    plain = PlainGPO(model, getattr(model, "delta", None), 0.7 if cls is GPOPenalty else None)
    batch = next(model.rollout_buffer.get(64))
    noise = th.randn(64, 1)
    coefficients = {name: coefficient.value for name, coefficient in model.coefficients.items()}
    loss = model.loss(batch._replace(advantages=model.advantages(batch)), noise, th.tensor(0.3), coefficients)
    expected = plain.loss(batch, noise, 0.3)
    assert loss.value.item() == pytest.approx(expected.item(), rel=1e-4)
    loss.value.backward()
    expected.backward()
    learner, guider = model.policy.learner, model.policy.guider
    entering = [guider.privileged.weight.grad, learner.latent_net[0].weight.grad, learner.is_learner.grad[:, None]]
    th.testing.assert_close(th.cat(entering, dim=1).double(), plain.named["w1"].grad, rtol=2e-3, atol=2e-5)
    of_heads = {"mean_weight": learner.head.mean.weight, "log_std_weight": learner.head.log_std.weight}
    others = {"w2": learner.latent_net[2].weight, "v_4_weight": model.policy.critic.value_net[4].weight, **of_heads}
    for name, ours in others.items():
        th.testing.assert_close(ours.grad.double(), plain.named[name].grad, rtol=2e-3, atol=2e-5)


@pytest.mark.parametrize("cls", BOTH)
def test_each_loss_is_logged_under_its_own_name(cls):
    """As in SB3's PPO, ``loss`` is the sum; the learner's loss has no part in the state value's."""
    model = make_model(cls=cls, n_epochs=1, vf_coef=0.5, ent_coef=0.01, env=TwoViewBandit(length=3)).learn(16)
    logged = {name: model.logger.name_to_value[f"train/{name}"] for name in LOSSES}
    parts = logged["guider_loss"] + logged["learner_loss"] - 0.01 * logged["entropy"] + 0.5 * logged["critic_loss"]
    assert logged["loss"] == pytest.approx(parts, rel=1e-4, abs=1e-6)
    assert logged["actor_loss"] == logged["learner_loss"] != logged["loss"]


def test_where_both_policies_see_the_same_it_is_ppo_step_for_step():
    """SB3's, on the same rollouts: the learner's own objective left out, one network is one policy."""
    env = DummyVecEnv([lambda: TwoViewChoice(length=3)] * 2)
    arguments = {"learning_rate": 3e-3, "n_steps": 32, "batch_size": 16, "n_epochs": 3, "seed": 0, "device": "cpu"}
    one_view = {"role_keys": {"guider": ["partial"], "critic": ["partial"]}}
    options = {"optimizer_kwargs": {"eps": 1e-5}, **OF_POLICY}
    model = GPOClip(
        "MultiInputPolicy",
        env,
        clip_range=0.2,
        vf_coef=0.5,
        max_grad_norm=0.5,
        learner_rl_coef=0.0,
        policy_kwargs=options,
        **arguments,
        **one_view,
    )
    theirs = PPO("MultiInputPolicy", _OnlyPartial(env), policy_kwargs=OF_POLICY, **arguments)
    pairs = list(zip(_parameters(theirs), _parameters(model), strict=True))
    with th.no_grad():
        for their, our in pairs:
            their.copy_(our)
    _, callback = model._setup_learn(1000, None)
    theirs._setup_learn(1000, None)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    buffer = theirs.rollout_buffer
    for name in ("actions", "rewards", "episode_starts", "values", "log_probs", "advantages", "returns"):
        getattr(buffer, name)[...] = getattr(model.rollout_buffer, name)
    buffer.observations["partial"][...] = model.rollout_buffer.observations["partial"]
    buffer.pos, buffer.full = model.n_steps, True
    for one in (model, theirs):
        np.random.seed(4)  # of the minibatches
        one.train()
    for their, our in pairs:
        th.testing.assert_close(our, their, rtol=1e-4, atol=1e-6)
    assert model.policy.learner.is_learner.abs().max() < 1e-5, "nothing but rounding"


class _OnlyPartial(DummyVecEnv):
    def __init__(self, env):
        super().__init__([lambda: TwoViewChoice(length=3)] * env.num_envs)
        self.observation_space = spaces.Dict(partial=env.observation_space["partial"])


def _parameters(model):
    policy = model.policy
    if isinstance(model, PPO):
        parts = (policy.mlp_extractor.policy_net, policy.action_net, policy.mlp_extractor.value_net, policy.value_net)
        return [p for part in parts for p in part.parameters()]
    value = policy.critic.value_net
    parts = (policy.learner.latent_net, policy.learner.head, value)
    return [p for part in parts for p in part.parameters()]


# --- rollouts --------------------------------------------------------------------------------------------------------------


class StopAt(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        return self.num_timesteps != self.step


@pytest.mark.parametrize("step", [5, 16, 40])
@pytest.mark.parametrize("cls", BOTH)
def test_to_be_stopped_and_to_go_on_is_not_to_be_stopped(cls, step):
    whole = make_model(cls=cls).learn(64)
    parts = make_model(cls=cls).learn(64, callback=StopAt(step))
    assert parts.num_timesteps == step
    parts.learn(64 - step, reset_num_timesteps=False)
    assert _same(whole, parts)


@pytest.mark.parametrize("step", [5, 32, 40])
@pytest.mark.parametrize("cls", BOTH)
def test_resumed_training_is_the_uninterrupted_one(cls, step, tmp_path):
    whole = make_model(cls=cls).learn(64)
    part = make_model(cls=cls).learn(64, callback=StopAt(step) if step % 16 else StopAt(-1)) if step % 16 else None
    part = make_model(cls=cls).learn(step) if part is None else part
    part.save_checkpoint(tmp_path)
    again = cls.resume(tmp_path, TwoViewBandit(length=3), device="cpu")
    again.learn(64 - step, reset_num_timesteps=False)
    assert _same(whole, again)
    assert float(again.coefficient_values().get("kl_coef", 0)) == float(whole.coefficient_values().get("kl_coef", 0))


def test_what_a_time_limit_cuts_bootstraps_and_what_ends_does_not():
    class Limited(TwoViewBandit):
        def step(self, action):
            obs, _, ended, _, info = super().step(action)
            return obs, 1.0, False, ended, info

    for env, bootstraps in ((Limited(), True), (TwoViewBandit(), False)):
        model = make_model(env, n_steps=4, batch_size=4, gamma=0.5, reward_scale=0.1)
        with th.no_grad():
            model.policy.critic.value_net[-1].weight.zero_()
            model.policy.critic.value_net[-1].bias.fill_(3.0)
        _, callback = model._setup_learn(100, None)
        model.collect_rollouts(model.env, callback, model.rollout_buffer, 4)
        if bootstraps:
            np.testing.assert_allclose(model.rollout_buffer.rewards, 0.1 + 0.5 * 3, rtol=1e-6)
        else:
            assert (model.rollout_buffer.rewards <= 0).all()


def test_an_evaluation_on_the_training_environments_cuts_the_rollout_as_a_time_limit_would():
    class Evaluates(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 2:
                self.training_env.reset()
            return True

    model = make_model(TwoViewBandit(length=100), n_steps=4, batch_size=4, gamma=0.5)
    with th.no_grad():
        model.policy.critic.value_net[-1].weight.zero_()
        model.policy.critic.value_net[-1].bias.fill_(3.0)
    _, callback = model._setup_learn(100, Evaluates())
    callback.on_training_start(locals(), globals())
    with pytest.warns(UserWarning, match="stepped or reset from outside"):
        model.collect_rollouts(model.env, callback, model.rollout_buffer, 4)
    buffer = model.rollout_buffer
    assert buffer.episode_starts[:, 0].tolist() == [1, 0, 1, 0]
    assert (buffer.rewards[1] > 0.5).all(), "a negative reward and the value of what was cut"
    assert (buffer.rewards[[0, 2, 3]] <= 0).all()


@pytest.mark.parametrize("cls", BOTH)
def test_a_fault_costs_the_episode_alone(cls):
    class Fails(TwoViewBandit):
        calls = 0

        def step(self, action):
            type(self).calls += 1
            obs, reward, *rest = super().step(action)
            return obs, (np.nan if self.calls == 21 else reward), *rest

    model = make_model(Fails(length=3), cls)
    with pytest.raises(InvalidStepError, match=r"reward.*num_timesteps"):
        model.learn(64)
    assert (model.num_timesteps, model.rollout_buffer.pos) == (20, 4)
    assert model.learn(44, reset_num_timesteps=False).num_timesteps == 64


# --- promises --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", BOTH)
@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
def test_the_learner_reads_what_it_may_and_is_exported(cls, env, tmp_path):
    model = make_model(env(), cls).learn(32)
    assert list(model.policy.learner.observation_space.spaces) == ["partial"]
    obs, _ = env().reset(seed=0)
    other = {**obs, "privileged": obs["privileged"] + 1}
    actions = [model.predict(one, deterministic=True)[0] for one in (obs, other, {"partial": obs["partial"]})]
    assert actions[0] == actions[1] == actions[2]
    assert not np.array_equal(*[model.policy.guider.distribution(_tensors(one))[0].detach() for one in (obs, other)])
    path = export_learner(model, tmp_path / "learner.onnx")
    np.testing.assert_allclose(OnnxPolicy.load(path).act(obs["partial"]), actions[0], atol=1e-5)
    model.save(tmp_path / "model")
    assert cls.load(tmp_path / "model").predict(obs, deterministic=True)[0] == actions[0]


def _tensors(obs):
    return {key: th.as_tensor(value)[None] for key, value in obs.items()}


def test_observations_may_be_normalised(tmp_path):
    def make_env():
        return VecNormalize(DummyVecEnv([lambda: TwoViewBandit(length=3)]), norm_reward=False, clip_obs=5.0)

    whole = make_model(make_env()).learn(64)
    part = make_model(make_env()).learn(32)
    part.save_checkpoint(tmp_path)
    again = GPOClip.resume(tmp_path, make_env(), device="cpu").learn(32, reset_num_timesteps=False)
    assert _same(whole, again)
    assert again.trained_normalised


def test_other_environments_in_another_number():
    model = make_model().learn(32)
    model.set_env(DummyVecEnv([lambda: TwoViewBandit(length=3)] * 3))
    assert model.learn(48, reset_num_timesteps=False).num_timesteps == 80


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"delta": 1.5}, "delta must be"),
        ({"delta": 0.0}, "delta must be"),
        ({"learner_rl_coef": -1}, "learner_rl_coef must be"),
        ({"n_steps": 0}, "n_steps must be"),
        ({"batch_size": 1}, "raise batch_size or n_steps"),
        ({"n_steps": 17}, "leaves a minibatch of one of the 17 transitions"),
        ({"unroll_length": 0}, "unroll_length must be"),
        ({"clip_range": -0.1}, "clip_range must be"),
        ({"policy_kwargs": {"rnn_type": "gru"}}, "GPOClip has no form with a memory"),
        ({"policy_kwargs": {"net_arch": []}}, "net_arch must have a hidden layer"),
        ({"role_keys": {"guider": ["privileged"]}}, "guider.*lacks"),
    ],
)
def test_what_can_not_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_model(**arguments)


def test_layer_sizes_of_the_guider_have_no_effect_and_are_warned_of(tmp_path):
    """Models of earlier versions had to have them, and are still to be loaded."""
    sizes = {"learner": [8], "guider": [9], "critic": [8]}
    with pytest.warns(UserWarning, match=r"net_arch has \['guider'\], whose layers are those of the learner: leave them out"):
        model = make_model(policy_kwargs={"net_arch": sizes})
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match="net_arch has"):
        assert GPOClip.load(tmp_path / "model").policy.guider.net_arch == [8]


def test_layer_sizes_by_network_are_those_of_the_learner_and_of_the_critic():
    policy = make_model(policy_kwargs={"net_arch": {"learner": [8], "critic": [5, 4]}}).policy
    assert (policy.learner.net_arch, policy.guider.net_arch, policy.critic.net_arch) == ([8], [8], [5, 4])


def test_what_is_no_argument_is_refused():
    with pytest.raises(TypeError, match='GPOClip\\(\\) got "tau", which is no argument of GPOClip'):
        make_model(tau=0.1)


@pytest.mark.parametrize("cls", BOTH)
def test_it_learns_the_two_views(cls):
    """The best that the learner can do, where both views tell the target, is the target itself."""
    model = make_model(cls=cls, env=DummyVecEnv([TwoViewBandit] * 8), n_steps=32, batch_size=64, learning_rate=1e-3)
    model.learn(20_000)
    obs = {"partial": np.array([[-0.5, 0.0], [0.0, 0.0], [0.5, 0.0]], np.float32)}
    np.testing.assert_allclose(model.predict(obs, deterministic=True)[0][:, 0], [-0.5, 0.0, 0.5], atol=0.12)


@pytest.mark.parametrize("space", [spaces.Box(-1, 1, (), np.float32), spaces.MultiDiscrete([[3, 4], [2, 2]])])
def test_an_entry_that_the_rollout_buffer_can_not_hold_is_named(space):
    entries = {"partial": spaces.Box(-1, 1, (2,), np.float32), "more": space}
    with pytest.raises(ValueError, match="The rollout buffer can't hold the observation's entry \"more\" of shape"):
        make_model(Sampled(spaces.Dict(entries)))


def test_other_environments_must_leave_no_minibatch_of_one():
    model = make_model(DummyVecEnv([TwoViewBandit] * 2), n_steps=5, batch_size=4, n_epochs=1).learn(20)
    with pytest.raises(ValueError, match="batch_size=4 leaves a minibatch of one of the 5 transitions"):
        model.set_env(DummyVecEnv([TwoViewBandit]))
    assert model.n_envs == 2
    model.learn(20)


def test_a_last_rollout_beyond_the_end_is_trained_with_the_schedules_ends():
    model = make_model(n_steps=64, learning_rate=lambda progress: 1e-3 * progress, clip_range=lambda progress: 0.2 * progress)
    model.learn(100)
    assert model.num_timesteps == 128
    assert model.policy.guider.optimizer.param_groups[0]["lr"] == 0.0
    assert model.clip_range_tensor == 0.0


@pytest.mark.parametrize("cls", BOTH)
def test_ratios_begin_at_one_in_mixed_precision_too(cls):
    """As far as rounding in a batch of another size goes."""
    model = make_model(cls=cls, mixed_precision=True, n_steps=64, batch_size=64, n_epochs=1, learning_rate=1e-2)
    ratios, objective = [], model.guider_objective

    def seen(batch, guider, *others):
        ratios.append((guider.log_prob(batch.actions) - batch.old_log_prob).detach().exp())
        return objective(batch, guider, *others)

    model.guider_objective = seen
    model.learn(640)
    assert len(ratios) == 10
    assert th.stack(ratios).sub(1).abs().mean() < 1e-4
