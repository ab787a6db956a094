"""AsymmetricSAC: SB3's own gradient step on one view, the right views otherwise, and SB3's contract."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC

from sb3_gac import AsymmetricSAC
from tests.helpers import TwoViewBandit, small_model

BOTH = ["partial", "privileged"]


def _small(**arguments):
    return small_model(cls=AsymmetricSAC, **arguments)


def _copy_weights(theirs, ours):
    """SB3's networks with one hidden layer -> ours, which keep features and actions apart and critics in one tensor."""

    def set_linear(layer, source):
        layer.weight.data.copy_(source.weight)
        layer.bias.data.copy_(source.bias)

    set_linear(ours.actor.latent_net[0], theirs.actor.latent_pi[0])
    set_linear(ours.actor.head.mean, theirs.actor.mu)
    set_linear(ours.actor.head.log_std, theirs.actor.log_std)
    for ensemble, critic in ((ours.critic, theirs.critic), (ours.critic_target, theirs.critic_target)):
        for i, (first, _, last) in enumerate(critic.q_networks):
            n_features = ensemble.input.features_weight.shape[1]
            ensemble.input.features_weight.data[i] = first.weight.data.t()[:n_features]
            ensemble.input.actions_weight.data[i] = first.weight.data.t()[n_features:]
            ensemble.input.bias.data[i, 0] = first.bias.data
            ensemble.output.weight.data[i] = last.weight.data
            ensemble.output.bias.data[i] = last.bias.data


@pytest.mark.parametrize("ent_coef", [0.0, 0.3])
def test_a_gradient_step_on_one_view_is_that_of_sb3s_sac(ent_coef):
    """With both views for both roles, noise held at zero and SB3's settings, three steps end at the same weights."""
    policy_kwargs = {"net_arch": [16], "activation_fn": th.nn.ReLU}
    shared = {"learning_starts": 1000, "buffer_size": 1000, "batch_size": 16, "ent_coef": ent_coef, "device": "cpu", "seed": 0}
    theirs = SAC("MultiInputPolicy", TwoViewBandit(length=5), policy_kwargs=dict(policy_kwargs), **shared).learn(100)
    ours = AsymmetricSAC(
        "MultiInputPolicy",
        TwoViewBandit(length=5),
        policy_kwargs={**policy_kwargs, "log_std_bounds": (-20.0, 2.0)},
        role_keys={"actor": BOTH},
        max_grad_norm=None,
        **shared,
    ).learn(100)
    _copy_weights(theirs.policy, ours.policy)
    ours.replay_buffer = theirs.replay_buffer
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(th.distributions.Normal, "rsample", lambda self, shape=(): self.mean.clone())
        patch.setattr(th, "randn", th.zeros)
        for model in (theirs, ours):
            np.random.seed(3)
            model.train(3, 16)
    obs = {"partial": th.randn(32, 2), "privileged": th.randn(32, 1)}
    actions = th.rand(32, 1) * 2 - 1
    for network in ("critic", "critic_target"):
        expected = th.cat(getattr(theirs.policy, network)(obs, actions), dim=1).t()
        th.testing.assert_close(getattr(ours.policy, network)(obs, actions), expected, rtol=1e-4, atol=1e-5)
    mean, log_std, _ = theirs.policy.actor.get_action_dist_params(obs)
    actor = ours.policy.actor.distribution(obs)
    th.testing.assert_close(actor.mean, mean, rtol=1e-4, atol=1e-5)
    th.testing.assert_close(actor.log_std, log_std, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("role_keys", "actor", "critic"),
    [
        (None, ["partial"], BOTH),
        ({"critic": ["partial"]}, ["partial"], ["partial"]),
        ({"actor": BOTH}, BOTH, BOTH),
    ],
)
def test_roles_read_their_entries_and_nothing_else(role_keys, actor, critic):
    policy = _small(role_keys=role_keys).policy
    obs = {"partial": th.randn(8, 2, requires_grad=True), "privileged": th.randn(8, 1, requires_grad=True)}
    for output, keys in ((policy.actor.distribution(obs).mean, actor), (policy.critic(obs, th.zeros(8, 1)), critic)):
        gradients = th.autograd.grad(output.sum(), list(obs.values()), allow_unused=True)
        assert [key for key, gradient in zip(obs, gradients, strict=True) if gradient is not None] == keys


def test_each_loss_moves_its_own_network():
    model = _small(learning_starts=1000).learn(64)
    batch = model._sample_batch(32)

    def changed(update):
        before = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
        update()
        return {name.split(".")[0] for name, p in model.policy.named_parameters() if not th.equal(p, before[name])}

    (actor,) = model.outputs(batch, "actor")
    noise, beta = th.randn(32, 1), th.tensor(0.1)
    assert changed(lambda: model.minimize("critic", model.critic_loss, batch, actor, noise, beta)) == {"critic"}
    assert changed(lambda: model.minimize("actor", model.actor_loss, batch, actor, noise, beta)) == {"actor"}


def test_learns_what_can_be_known_from_the_partial_view():
    """Noise as large as the target's spread: the best guess is the posterior mean, of half the size of what is seen."""
    model = _small(env=TwoViewBandit(noise_std=0.46), learning_rate=3e-3, batch_size=64, learning_starts=200, ent_coef=0.003)
    model.learn(1500)
    seen = np.array([[0.4, 0.0], [-0.4, 0.0]], dtype=np.float32)
    action, _ = model.predict({"partial": seen}, deterministic=True)
    assert 0.05 < action[0, 0] < 0.35
    assert -0.35 < action[1, 0] < -0.05


def test_saves_loads_and_goes_on(tmp_path):
    model = _small(n_steps=2).learn(40)
    model.save(tmp_path / "model")
    loaded = AsymmetricSAC.load(tmp_path / "model", env=TwoViewBandit())
    obs = {"partial": np.ones(2, np.float32)}
    np.testing.assert_array_equal(*(m.predict(obs, deterministic=True)[0] for m in (model, loaded)))
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 60
    assert set(model.get_parameters()) == {
        "policy",
        "policy.actor.optimizer",
        "policy.critic.optimizer",
        "ent_coef_dual.optimizer",
    }


def test_logs_what_sac_logs():
    model = _small().learn(30)
    logged = {name for name in model.logger.name_to_value if name.startswith("train/")}
    assert logged >= {
        f"train/{name}" for name in ("actor_loss", "critic_loss", "ent_coef", "ent_coef_loss", "n_updates", "learning_rate")
    }


def test_runs_are_reproducible():
    one, two = (_small(seed=3).learn(60) for _ in range(2))
    for p, q in zip(one.policy.parameters(), two.policy.parameters(), strict=True):
        assert th.equal(p, q)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"role_keys": {"guider": ["partial"]}}, r"unknown roles \['guider'\]; the roles are \['actor', 'critic'\]"),
        ({"role_keys": {"critic": ["depth"]}}, r"unknown observation entries \['depth'\]"),
        ({"policy_kwargs": {"net_arch": {"learner": [8], "critic": [8]}}}, "net_arch must be"),
        ({"lr_scales": {"guider": 2.0}}, "lr_scales names unknown roles"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        _small(**arguments)


def test_groups_of_critics_are_of_one_size():
    message = r"critic_groups=2 can't be of the same size with 3 critics: give policy_kwargs"
    with pytest.raises(ValueError, match=message):
        small_model(cls=AsymmetricSAC, critic_groups=2, policy_kwargs={"n_critics": 3})
    model = small_model(cls=AsymmetricSAC, critic_groups=2, policy_kwargs={"n_critics": 4}).learn(20)
    for groups in (3, 8):
        model.critic_groups = groups
        with pytest.raises(ValueError, match=f"critic_groups={groups} can't be of the same size with 4 critics"):
            model.learn(20, reset_num_timesteps=False)
        assert model.critic_groups == 2, "what it was"


def test_groups_of_critics_are_compiled():
    arguments = {"critic_groups": 2, "policy_kwargs": {"net_arch": [8], "n_critics": 4}}
    plain, compiled = (small_model(cls=AsymmetricSAC, compile=compile, **arguments).learn(25) for compile in (False, True))
    for p, q in zip(plain.policy.parameters(), compiled.policy.parameters(), strict=True):
        th.testing.assert_close(p, q, rtol=1e-4, atol=1e-6)
