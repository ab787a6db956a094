"""Hooks for algorithms, who acts, how often networks take a step, and what checkpoints keep of it."""

import itertools

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import COSIL, GAC, RMA, TGRL, AsymmetricSAC
from tests.helpers import Recall, Sampled, TwoViewBandit, small_model


class Watching(AsymmetricSAC):
    """Writes down what its hooks are told."""

    def __init__(self, *args, **kwargs):
        self.steps, self.ends = [], []
        super().__init__(*args, **kwargs)

    def on_step(self):
        self.steps.append((self.num_timesteps, self.replay_buffer.size()))

    def on_episode_end(self, env, episode_return, role):
        self.ends.append((self.num_timesteps, env, round(episode_return, 4), role))

    def training_state(self):
        return {"steps": self.steps, "ends": self.ends}


class Counted(TwoViewBandit):
    """Its reward is always the same."""

    def __init__(self, length, reward=1.0):
        super().__init__(length=length)
        self.reward = reward

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.reward, *rest


def test_hooks_come_after_each_step_is_stored_with_returns_and_roles():
    envs = DummyVecEnv([lambda: Counted(2), lambda: Counted(3, reward=10.0)])
    model = small_model(envs, Watching, learning_starts=3).learn(12)
    assert model.steps == [(2 * n, n) for n in range(1, 7)]
    # in the first two steps actions are uniform
    assert model.ends == [
        (4, 0, 2.0, None),
        (6, 1, 30.0, None),
        (8, 0, 2.0, "actor"),
        (12, 0, 2.0, "actor"),
        (12, 1, 30.0, "actor"),
    ]


def test_returns_are_those_before_normalisation():
    envs = VecNormalize(DummyVecEnv([lambda: Counted(4, reward=100.0)]))
    assert {end[2] for end in small_model(envs, Watching).learn(40).ends} == {400.0}


def test_what_hooks_gather_is_in_checkpoints(tmp_path):
    through, stopped = (small_model(Counted(3), Watching).learn(steps) for steps in (40, 23))
    stopped.save_checkpoint(tmp_path)
    resumed = Watching.resume(tmp_path, Counted(3), device="cpu").learn(17, reset_num_timesteps=False)
    assert [tuple(end) for end in resumed.ends] == through.ends
    assert [tuple(step) for step in resumed.steps] == through.steps


# --- behaviour -----------------------------------------------------------------------------------------------------


def _roles_of_episodes(model, steps):
    """Role that acts, of each episode of each environment, which it must do to the end."""
    seen = []
    choose = model.choose_acting

    def spy(episode_start):
        acting = choose(episode_start)
        seen.append((list(acting), list(episode_start)))
        return acting

    model.choose_acting = spy
    model.learn(steps)
    for (before, _), (after, starts) in itertools.pairwise(seen):
        assert all(old == new for old, new, start in zip(before, after, starts, strict=True) if not start)
    return [role for acting, starts in seen for role, start in zip(acting, starts, strict=True) if start]


@pytest.mark.parametrize(
    ("behaviour", "share"), [(None, 0.0), ("learner", 1.0), ({"learner": 0.3}, 0.3), ({"learner": 1.0}, 1.0)]
)
def test_a_share_of_episodes_is_the_learners(behaviour, share):
    model = small_model(TwoViewBandit(length=3), behaviour=behaviour, gradient_steps=0)
    roles = _roles_of_episodes(model, 1500)
    assert len(roles) == 500
    assert np.mean([role == "learner" for role in roles]) == pytest.approx(share, abs=0.07 if share == 0.3 else 0)


def test_a_share_may_be_a_schedule():
    model = small_model(behaviour={"learner": lambda left: 1 - left}, gradient_steps=0)
    roles = _roles_of_episodes(model, 1000)
    early, late = (np.mean([role == "learner" for role in part]) for part in (roles[:300], roles[-300:]))
    assert early < 0.25 < 0.75 < late


def test_a_share_may_be_one_of_environments():
    envs = DummyVecEnv([lambda: TwoViewBandit(length=2) for _ in range(4)])
    model = small_model(envs, behaviour={"learner": 0.25}, behaviour_per="environment", gradient_steps=0).learn(40)
    assert model.acting == ["learner", "guider", "guider", "guider"]


@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MultiInputGruPolicy"])
def test_each_environment_gets_the_action_of_who_acts_there_and_memories_run_along(policy):
    sizes = {} if policy == "MultiInputPolicy" else {"rnn_hidden_size": 8, "rnn_net_arch": [8]}
    model = small_model(Recall(continuous=True), policy=policy, policy_kwargs={"net_arch": [8], **sizes}, batch_size=4).learn(
        20
    )
    obs = {key: np.stack([space.sample() for _ in range(3)]) for key, space in model.observation_space.items()}
    starts = np.ones(3, dtype=bool)
    alone = {role: model.policy.behaviour_action(obs, None, starts, True, acting=[role] * 3) for role in ("guider", "learner")}
    mixed, state = model.policy.behaviour_action(obs, None, starts, True, acting=["learner", "guider", "learner"])
    np.testing.assert_array_equal(mixed[[0, 2]], alone["learner"][0][[0, 2]])
    np.testing.assert_array_equal(mixed[1], alone["guider"][0][1])
    assert not np.allclose(alone["guider"][0], alone["learner"][0])
    if state is not None:
        for one, other in zip(state, alone["guider"][1], strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("behaviour", "message"),
    [
        ("critic", "behaviour: a policy must be one of"),
        ({"guide": 0.1}, "behaviour: a policy must be one of"),
        ({"learner": 1.2}, "behaviour must be shares from 0 to 1"),
        ({"learner": 0.6, "guider": 0.6}, "sum up to 1 at most"),
        (0.3, "behaviour must be a policy's name, a dict of shares or None"),
    ],
)
def test_bad_behaviours_are_named(behaviour, message):
    with pytest.raises(ValueError, match=message):
        small_model(behaviour=behaviour)


def test_who_acts_goes_on_after_a_resume(tmp_path):
    def make():
        return small_model(TwoViewBandit(length=7), behaviour={"learner": 0.5})

    through, stopped = make().learn(80), make().learn(52)
    stopped.save_checkpoint(tmp_path)
    resumed = GAC.resume(tmp_path, TwoViewBandit(length=7), device="cpu")
    assert resumed.acting == stopped.acting
    resumed.learn(28, reset_num_timesteps=False)
    assert all(th.equal(p, q) for p, q in zip(resumed.policy.parameters(), through.policy.parameters(), strict=True))


# --- how often networks take a step --------------------------------------------------------------------------------


def _moves(model, n):
    """Networks that each of n gradient steps has moved."""
    moved = []
    for _ in range(n):
        before = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
        model.train(1, 8)
        changed = {name.split(".")[0] for name, p in model.policy.named_parameters() if not th.equal(p, before[name])}
        moved.append({name for name in changed if not name.endswith("_target")})
    return moved


@pytest.mark.parametrize("compiled", [False, True])
def test_policies_may_wait_and_networks_have_intervals_of_their_own(compiled):
    critics, policies = {"guider_critic", "learner_critic"}, {"guider", "learner"}
    model = small_model(learning_starts=1000, policy_delay=2, compile=compiled).learn(30)
    assert _moves(model, 4) == [critics | policies, critics] * 2
    if compiled:
        return
    model = small_model(learning_starts=1000, update_every={"learner": 3, "critic": 2}).learn(30)
    assert _moves(model, 4) == [critics | policies, {"guider"}, critics | {"guider"}, {"guider", "learner"}]


def test_a_network_that_rests_is_logged_nevertheless():
    model = small_model(learning_starts=1000, update_every={"learner": 2}).learn(30)
    model.train(4, 8)
    logged = model.logger.name_to_value
    assert {"train/learner_loss", "train/learner_grad_norm", "train/actor_loss"} <= set(logged)
    assert logged["train/learner_grad_norm"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy_delay": 0}, "policy_delay must be"),
        ({"update_every": {"lerner": 2}}, "update_every names unknown roles"),
        ({"update_every": {"learner": 1.5}}, r'update_every\["learner"\] must be'),
        ({"update_every": 2}, "update_every must be a dict of networks or None"),
        ({"policy_kwargs": {"rnn_type": {"critics": "gru"}}}, "rnn_type names unknown roles"),
        ({"policy_kwargs": {"rnn_type": "rnn"}}, "rnn_type must be one of"),
        ({"lr_scales": {"memory": 0.1}}, 'lr_scales names "memory", but no network has one'),
        (
            {"lr_scales": {"memory": 0.1}, "policy_kwargs": {"rnn_type": "gru", "optimizer_class": th.optim.SGD}},
            'a learning rate for "memory" goes with torch',
        ),
        (
            {"policy_kwargs": {"features_extractor_class": {"lerner": CombinedExtractor}}},
            "features_extractor_class names unknown roles",
        ),
    ],
)
def test_bad_settings_of_roles_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        small_model(**arguments)


class OnlyTheActor(AsymmetricSAC):
    """Leaves its critics as they are, once it is told to."""

    at_rest = frozenset()

    def update(self, batch):
        self.training = {role: getattr(self.policy, role).training for role in ("actor", "critic")}
        return super().update(batch)


def test_networks_at_rest_stay_as_they_are():
    """To the bit, whatever is minimised, with targets and in evaluation mode."""
    model = small_model(cls=OnlyTheActor, learning_rate=0.1).learn(14)
    assert model.training == {"actor": True, "critic": True}
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.at_rest = frozenset(["critic"])
    model.learn(6, reset_num_timesteps=False)
    moved = {name.split(".")[0] for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}
    assert moved == {"actor"}
    assert model.training == {"actor": True, "critic": False}


# --- networks by role ----------------------------------------------------------------------------------------------


def test_a_memory_for_the_learner_alone_stays_with_it_through_a_file(tmp_path):
    sizes = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8], "rnn_type": {"learner": "gru"}}
    model = small_model(Recall(), policy_kwargs=sizes, batch_size=4).learn(60)
    memories = {role: getattr(model.policy, role).memory is not None for role in model.policy.roles.all}
    assert memories == {"learner": True, "guider": False, "guider_critic": False, "learner_critic": False}
    model.save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", env=Recall())
    obs = {"partial": np.eye(4, dtype=np.float32)}
    action, state = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], action)
    assert state[0].shape == (4, 8)
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 80


@pytest.mark.parametrize(
    ("algorithm", "arguments", "remember"),
    [
        (GAC, {}, {"learner"}),
        (AsymmetricSAC, {}, {"actor"}),
        (AsymmetricSAC, {"role_keys": {"critic": ["partial"]}}, {"actor", "critic"}),
        (AsymmetricSAC, {"role_keys": {"actor": ["partial", "privileged"]}}, set()),
        (AsymmetricSAC, {"policy_kwargs": {"role_keys": {"critic": ["partial"]}}}, {"actor", "critic"}),
        (TGRL, {}, {"actor", "auxiliary"}),
        (COSIL, {}, {"actor", "critic"}),
    ],
)
def test_who_sees_partial_alone_may_be_given_a_memory(algorithm, arguments, remember):
    of_policy = {"net_arch": [8], "rnn_type": {"partial": "gru"}, **arguments.get("policy_kwargs", {})}
    model = small_model(Recall(), algorithm, **(arguments | {"policy_kwargs": of_policy, "batch_size": 4}))
    assert {role for role in model.policy.roles.all if getattr(model.policy, role).memory is not None} == remember
    assert model.is_recurrent == bool(remember)


def test_a_memory_follows_its_own_learning_rate_after_load(tmp_path):
    """With a rate of next to nothing it stays where it is, while the rest of its network learns."""
    options = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8], "rnn_type": {"partial": "gru"}}
    model = small_model(Recall(), policy_kwargs=options, batch_size=4, lr_scales={"memory": 1e-12, "learner": 2.0})

    def moved(model):
        before = {name: p.detach().clone() for name, p in model.policy.learner.named_parameters()}
        model.learn(60, reset_num_timesteps=False)
        return {
            name.split(".")[0] for name, p in model.policy.learner.named_parameters() if (p - before[name]).abs().max() > 1e-6
        }

    assert "memory" not in (others := moved(model))
    assert others
    model.save(tmp_path / "model")
    assert moved(GAC.load(tmp_path / "model", env=Recall())) == others
    assert moved(GAC.load(tmp_path / "model", env=Recall(), lr_scales={"memory": 0.5})) == others | {"memory"}


def test_encoders_by_role():
    from stable_baselines3.common.torch_layers import FlattenExtractor

    class Doubled(FlattenExtractor):
        """Of one entry."""

        def forward(self, observations):
            return 2 * th.cat([values.flatten(1) for values in observations.values()], dim=1)

    model = small_model(policy_kwargs={"net_arch": [8], "features_extractor_class": {"critic": Doubled}}).learn(20)
    kinds = {role: type(getattr(model.policy, role).features_extractor) for role in model.policy.roles.all}
    assert kinds["guider_critic"] is kinds["learner_critic"] is Doubled
    assert kinds["learner"] is kinds["guider"] is not Doubled


def test_two_networks_may_share_a_loss():
    """As an encoder that a critic's loss trains: each has its own optimiser and its own bound."""
    from sb3_gac.base.batch import Loss

    model = small_model(learning_starts=1000).learn(30)
    batch = model._sample_batch(8)

    def loss(batch):
        q = model.policy.guider_critic(batch.observations, model.policy.guider.distribution(batch.observations).mode)
        return Loss(q.mean(), {})

    before = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
    metrics = model.minimize(("guider_critic", "guider"), loss, batch)
    changed = {name.split(".")[0] for name, p in model.policy.named_parameters() if not th.equal(p, before[name])}
    assert changed == {"guider_critic", "guider"}
    assert set(metrics) == {"guider_critic_loss", "guider_critic_grad_norm", "guider_grad_norm"}


def test_every_algorithm_collects_with_its_own():
    teacher = small_model(Sampled(TwoViewBandit().observation_space), AsymmetricSAC)
    behaviours = {cls: cls.policy_aliases["MultiInputPolicy"].roles.behaviour for cls in (GAC, AsymmetricSAC, TGRL, RMA)}
    assert behaviours == {GAC: "guider", AsymmetricSAC: "actor", TGRL: "actor", RMA: "expert"}
    assert teacher.policy.roles.behaviour == "actor"
