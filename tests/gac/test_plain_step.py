"""The fast gradient step does what a plain one does: one network after the other, torch's own layers, losses and clipping."""

from copy import deepcopy

import pytest
import torch as th
from torch import nn

from tests.helpers import small_model

ALPHA_RATE, RATE, TAU, GAMMA, TARGET_KL = 3e-3, 3e-4, 0.005, 0.99, 0.0033


def _plain_actor(policy):
    return nn.ModuleDict(deepcopy({"latent_net": policy.latent_net, "mean": policy.head.mean, "log_std": policy.head.log_std}))


def _plain_critics(ensemble):
    critics = nn.ModuleList()
    for i in range(2):
        weight = th.cat([ensemble.input.features_weight[i], ensemble.input.actions_weight[i]]).t()
        critic = nn.Sequential(nn.Linear(weight.shape[1], weight.shape[0]), nn.SiLU(), nn.Linear(weight.shape[0], 1))
        state = {"0.weight": weight, "0.bias": ensemble.input.bias[i, 0]}
        critic.load_state_dict(state | {"2.weight": ensemble.output.weight[i], "2.bias": ensemble.output.bias[i]})
        critics.append(critic)
    return critics


class PlainGAC:
    """Algorithm 1 with the residual guider, as one would write it first."""

    def __init__(self, model):
        policy = model.policy
        self.learner_owns_std = model.std_of == "learner"
        self.learner, self.guider = _plain_actor(policy.learner), _plain_actor(policy.guider)
        self.theta, self.phi = _plain_critics(policy.guider_critic), _plain_critics(policy.learner_critic)
        self.theta_bar, self.phi_bar = deepcopy(self.theta), deepcopy(self.phi)
        self.log_alpha = model.kl_coef_dual.log_value.detach().clone().requires_grad_()
        self.log_beta = model.ent_coef_dual.log_value.detach().clone().requires_grad_()
        self.target_entropy = model.target_entropy
        networks = (self.theta, self.phi, self.guider, self.learner)
        self.optimizers = {network: th.optim.Adam(network.parameters(), lr=RATE) for network in networks}
        self.dual_optimizers = [th.optim.Adam([self.log_alpha], lr=ALPHA_RATE), th.optim.Adam([self.log_beta], lr=RATE)]

    def policies(self, obs):
        o, s = obs["partial"], th.cat([obs["partial"], obs["privileged"]], dim=1)
        seen_by_learner = self.learner["latent_net"](o)
        mean = self.learner["mean"](seen_by_learner)
        hidden = self.guider["latent_net"](s)
        log_std = self.learner["log_std"](seen_by_learner) if self.learner_owns_std else self.guider["log_std"](hidden)
        std = log_std.clamp(-5, 1).exp()
        guider_mean = mean.detach() + std.detach() * self.guider["mean"](hidden)
        return mean, guider_mean, std

    @staticmethod
    def sample(mean, std, noise):
        normal = th.distributions.Normal(mean, std)
        squashed = th.distributions.TransformedDistribution(normal, th.distributions.TanhTransform(cache_size=1))
        action = th.tanh(mean + std * noise)
        return action, squashed.log_prob(action.clamp(-1 + 1e-7, 1 - 1e-7)).sum(dim=1)

    @staticmethod
    def q(critics, obs, action):
        x = th.cat([obs["partial"], obs["privileged"], action], dim=1)
        return [critic(x)[:, 0] for critic in critics]

    def descend(self, network, loss, clipped):
        for optimizer in self.optimizers.values():
            optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(clipped, 1.0)
        self.optimizers[network].step()

    def step(self, batch, noise):
        alpha, beta = self.log_alpha.exp().detach(), self.log_beta.exp().detach()
        obs, next_obs = batch.observations, batch.next_observations
        with th.no_grad():
            mean, guider_mean, std = self.policies(next_obs)
            kl = (((guider_mean - mean) / std) ** 2 / 2).mean(dim=1)
            action, log_prob = self.sample(guider_mean, std, noise[0])
            value = th.minimum(*self.q(self.theta_bar, next_obs, action)) - alpha * kl - beta * log_prob
            y_theta = batch.rewards + GAMMA * (1 - batch.dones) * value
            action, log_prob = self.sample(mean, std, noise[2])
            value = th.minimum(*self.q(self.phi_bar, next_obs, action)) - beta * log_prob
            y_phi = batch.rewards + GAMMA * (1 - batch.dones) * value
        mean, guider_mean, std = self.policies(obs)
        for critics, y in ((self.theta, y_theta), (self.phi, y_phi)):
            loss = sum(0.5 * ((q - y) ** 2).mean() for q in self.q(critics, obs, batch.actions))
            self.descend(critics, loss, critics.parameters())
        kl = (((guider_mean - mean.detach()) / std.detach()) ** 2 / 2).mean(dim=1)
        action, log_prob = self.sample(guider_mean, std.detach() if self.learner_owns_std else std, noise[1])
        loss = (alpha * kl + beta * log_prob - th.minimum(*self.q(self.theta, obs, action))).mean()
        self.descend(self.guider, loss, self.guider.parameters())
        action, learner_log_prob = self.sample(mean, std if self.learner_owns_std else std.detach(), noise[3])
        loss = (beta * learner_log_prob - th.minimum(*self.q(self.phi, obs, action))).mean()
        clipped = list(self.learner.parameters())
        if not self.learner_owns_std:
            latent = self.learner["latent_net"](obs["partial"]).detach()
            loss = loss + 0.5 * ((self.learner["log_std"](latent).clamp(-5, 1) - std.detach().log()) ** 2).mean()
            clipped = [*self.learner["latent_net"].parameters(), *self.learner["mean"].parameters()]
        self.descend(self.learner, loss, clipped)
        violations = (kl.detach() - TARGET_KL, log_prob.detach() + self.target_entropy)
        for log_coef, violation, optimizer in zip(
            (self.log_alpha, self.log_beta), violations, self.dual_optimizers, strict=True
        ):
            optimizer.zero_grad()
            (-log_coef.exp() * violation.mean()).sum().backward()
            optimizer.step()
        with th.no_grad():
            for critics, targets in ((self.theta, self.theta_bar), (self.phi, self.phi_bar)):
                for p, q in zip(critics.parameters(), targets.parameters(), strict=True):
                    q.copy_(TAU * p + (1 - TAU) * q)


@pytest.mark.parametrize("std_of", ["learner", "guider"])
def test_the_fast_step_is_the_plain_step(std_of):
    model = small_model(learning_starts=1000, learning_rate=RATE, std_of=std_of)
    model.learn(64)
    with th.no_grad():  # a guider that differs from its learner, a std that differs between states
        model.policy.guider.head.mean.bias.add_(0.3)
        getattr(model.policy, std_of).head.log_std.weight.mul_(3.0)
    plain = PlainGAC(model)
    for seed in range(4):
        batch = model._sample_batch(32)
        th.manual_seed(seed)
        model._gradient_step(batch)
        model.policy.update_targets(TAU)
        th.manual_seed(seed)
        plain.step(batch, th.randn(4, 32, 1))

    policy, obs, actions = model.policy, batch.observations, batch.actions
    mean, guider_mean, std = plain.policies(obs)
    guider, learner, deployed = policy.distributions(obs)
    expected = {
        "learner": (learner.mean, mean),
        "guider": (guider.mean, guider_mean),
        "std": (guider.log_std.exp(), std),
        "deployment std": (deployed.log_std, plain.learner["log_std"](plain.learner["latent_net"](obs["partial"]))),
        "Q_theta": (policy.guider_critic(obs, actions), th.stack(plain.q(plain.theta, obs, actions))),
        "Q_phi": (policy.learner_critic(obs, actions), th.stack(plain.q(plain.phi, obs, actions))),
        "Q_theta target": (policy.guider_critic_target(obs, actions), th.stack(plain.q(plain.theta_bar, obs, actions))),
        "Q_phi target": (policy.learner_critic_target(obs, actions), th.stack(plain.q(plain.phi_bar, obs, actions))),
        "alpha": (model.kl_coef_dual.log_value, plain.log_alpha),
        "beta": (model.ent_coef_dual.log_value, plain.log_beta),
    }
    for name, (ours, theirs) in expected.items():
        th.testing.assert_close(ours, theirs, rtol=2e-4, atol=2e-5, msg=lambda text, name=name: f"{name}: {text}")
