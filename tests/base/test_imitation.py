"""Behaviour cloning, DAgger's data, and networks taken over from another model."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, AsymmetricMPO, AsymmetricSAC, GPOClip, clone_behaviour, copy_networks, demonstrate
from sb3_gac.base.imitation import Demonstrations
from sb3_gac.envs import make_vec
from sb3_gac.networks.encoders import VectorExtractor
from tests.helpers import TwoViewBandit, small_model

SMALL = {"policy_kwargs": {"net_arch": [16]}, "buffer_size": 500, "learning_starts": 20, "seed": 0}
GPO = {"policy_kwargs": {"net_arch": [16]}}
FULL = {"role_keys": {"actor": ["partial", "privileged"]}}


@pytest.fixture
def env():
    env = make_vec("sb3_gac/Pendulum-v1", 2, 0)
    yield env
    env.close()


@pytest.fixture
def choices():
    env = make_vec("sb3_gac/TigerDoor-v0", 2, 0)
    yield env
    env.close()


def _made_up(env, function, count=400):
    random = np.random.RandomState(0)
    observations = {key: np.stack([space.sample() for _ in range(count)]) for key, space in env.observation_space.items()}
    observations["partial"] = random.uniform(-1, 1, size=observations["partial"].shape).astype(np.float32)
    return Demonstrations(observations, function(observations["partial"]))


def test_the_deployed_policy_does_what_it_was_shown_and_nothing_else_moves(env):
    model = GAC("MultiInputPolicy", env, **SMALL)
    shown = _made_up(env, lambda partial: 2.0 * np.tanh(partial[:, :1]))  # torques are in [-2, 2]
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    errors = clone_behaviour(model, shown, gradient_steps=400, batch_size=64, learning_rate=1e-2)
    assert errors["after"] < 0.01 < errors["before"]
    action, _ = model.predict({"partial": shown.observations["partial"]}, deterministic=True)
    assert np.abs(action - shown.actions).mean() < 0.2
    moved = {name for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}
    assert moved
    assert all(name.startswith("learner.") and ".log_std." not in name for name in moved)


def test_standard_deviations_and_gpos_guider_change_with_the_layers_that_they_share(env):
    """As the documentation says: neither is fitted, and neither is held."""
    model = GPOClip("MultiInputPolicy", env, seed=0, **GPO)
    shown = _made_up(env, lambda partial: 2.0 * np.tanh(partial[:, :1]))
    observations, _ = model.policy.obs_to_tensor(dict(shown.observations))
    with th.no_grad():
        before = [getattr(model.policy, role).distribution(observations) for role in ("learner", "guider")]
    clone_behaviour(model, shown, gradient_steps=20, batch_size=64, learning_rate=1e-2)
    with th.no_grad():
        after = [getattr(model.policy, role).distribution(observations) for role in ("learner", "guider")]
    assert not th.equal(before[0].log_std, after[0].log_std)
    assert not th.equal(before[1].mean, after[1].mean)


def test_a_residual_guider_starts_at_what_was_cloned(env):
    model = GAC("MultiInputPolicy", env, **SMALL)
    shown = _made_up(env, lambda partial: 2.0 * np.tanh(partial[:, :1]))
    clone_behaviour(model, shown, gradient_steps=200, batch_size=64, learning_rate=1e-2)
    guided, _ = model.predict_guider(dict(shown.observations), deterministic=True)
    learned, _ = model.predict(dict(shown.observations), deterministic=True)
    assert np.abs(guided - learned).mean() < 0.1


def _target_of_mpo(env):
    model = AsymmetricMPO("MultiInputPolicy", env, **SMALL)
    return model, [(model.policy.actor, model.policy.actor_target)]


def _target_of_a_lagged_guider(env):
    model = GAC("MultiInputPolicy", env, guider="lagged", **SMALL)
    return model, [(model.policy.learner, model.policy.learner_target)]


def _targets_of_critics_that_share_the_encoder(env):
    options = {"share_features_extractor": True, "features_extractor_class": Encoder, "net_arch": [16]}
    model = GAC("MultiInputPolicy", env, **SMALL | {"policy_kwargs": options})
    pairs = [getattr(model.policy, name) for name in ("learner_critic", "learner_critic_target")]
    return model, [tuple(network.features_extractor for network in pairs)]


class Encoder(VectorExtractor):
    """With parameters of its own."""

    def __init__(self, observation_space, **kwargs):
        super().__init__(observation_space, **kwargs)
        self.linear = th.nn.Linear(self.features_dim, self.features_dim)

    def forward(self, observations):
        return self.linear(super().forward(observations))


TARGETS = [_target_of_mpo, _target_of_a_lagged_guider, _targets_of_critics_that_share_the_encoder]


@pytest.mark.parametrize("make", TARGETS, ids=lambda make: make.__name__)
def test_targets_begin_at_what_was_cloned(env, make):
    model, pairs = make(env)
    before = [value.clone() for network, _ in pairs for value in network.state_dict().values()]
    clone_behaviour(model, _made_up(env, lambda partial: 2.0 * np.tanh(partial[:, :1])), gradient_steps=20, batch_size=64)
    after = [value for network, _ in pairs for value in network.state_dict().values()]
    assert any(not one.equal(other) for one, other in zip(before, after, strict=True))
    for network, target in pairs:
        for name, value in network.state_dict().items():
            assert target.state_dict()[name].equal(value), name


def test_choices_are_cloned(choices):
    model = AsymmetricSAC("MultiInputPolicy", choices, **SMALL)
    heard = np.eye(3, dtype=np.float32)[np.arange(300) % 3]
    shown = Demonstrations({"partial": heard, "privileged": np.zeros((300, 5), np.float32)}, heard.argmax(1))
    assert clone_behaviour(model, shown, gradient_steps=200, batch_size=32, learning_rate=1e-2)["after"] == 0.0
    action, _ = model.predict({"partial": np.eye(3, dtype=np.float32)}, deterministic=True)
    assert action.tolist() == [0, 1, 2]


def test_training_goes_on_from_a_clone(env):
    model = GAC("MultiInputPolicy", env, **SMALL)
    clone_behaviour(model, _made_up(env, lambda partial: partial[:, :1]), gradient_steps=5)
    model.learn(60)
    assert model.num_timesteps >= 60


def test_a_clone_is_the_same_with_the_same_seed(env):
    shown = _made_up(env, lambda partial: partial[:, :1])
    errors = [clone_behaviour(GAC("MultiInputPolicy", env, **SMALL), shown, gradient_steps=20, seed=3) for _ in range(2)]
    assert errors[0] == errors[1]


def test_a_guider_shows_what_it_does_and_a_student_where_it_goes(env):
    teacher = GAC("MultiInputPolicy", env, **SMALL)
    shown = demonstrate(teacher, env, 7)
    assert len(shown) == 8, "four steps of both environments"
    assert set(shown.observations) == {"partial", "privileged"}
    expected, _ = teacher.predict_guider(dict(shown.observations), deterministic=True)
    np.testing.assert_allclose(shown.actions, expected, atol=1e-5)

    student = AsymmetricSAC("MultiInputPolicy", env, **SMALL | {"seed": 1})
    env.seed(0)
    by_student = demonstrate(teacher, env, 40, student=student)
    env.seed(0)
    by_teacher = demonstrate(teacher, env, 40)
    expected, _ = teacher.predict_guider(dict(by_student.observations), deterministic=True)
    np.testing.assert_allclose(by_student.actions, expected, atol=1e-5)
    assert not np.array_equal(by_student.observations["partial"], by_teacher.observations["partial"])
    assert len(by_student + by_teacher) == 80


def test_a_model_of_full_state_teaches_one_of_partial(env):
    teacher = AsymmetricSAC("MultiInputPolicy", env, **SMALL, **FULL)
    shown = demonstrate(teacher, env, 200)
    model = GAC("MultiInputPolicy", env, **SMALL)
    errors = clone_behaviour(model, shown, gradient_steps=200, batch_size=64, learning_rate=1e-2)
    assert errors["after"] < errors["before"]


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        ({"privileged": np.zeros((3, 3), np.float32)}, np.zeros((3, 1)), r"lack the entries \['partial'\]"),
        ({"partial": np.zeros((3, 2), np.float32)}, np.zeros((2, 1)), "3 observations and 2 actions"),
        ({"partial": np.zeros((3, 2), np.float32)}, np.full((3, 1), 5.0), r"action 0 is \[5\.\], which is not in"),
        ({"partial": np.zeros((3, 2), np.float32)}, np.full((3, 1), np.nan), "action 0 is"),
        ({"partial": np.zeros((1, 2), np.float32)}, np.zeros((1, 1)), "at least two"),
        ({"partial": np.zeros((3, 4), np.float32)}, np.zeros((3, 1)), "partial"),
    ],
)
def test_demonstrations_that_do_not_fit_are_refused(env, observations, actions, message):
    model = GAC("MultiInputPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=message):
        clone_behaviour(model, Demonstrations(observations, actions))


def test_actions_may_leave_their_range_by_rounding(env):
    """As SB3's own do where they are saturated, with bounds that are not symmetric."""
    space = env.action_space
    outside = np.nextafter(np.full((20, 1), space.high), np.float32(np.inf), dtype=np.float32)
    shown = Demonstrations({"partial": np.zeros((20, 2), np.float32)}, outside)
    model = GAC("MultiInputPolicy", env, **SMALL)
    assert clone_behaviour(model, shown, gradient_steps=2)["after"] < 4
    with pytest.raises(ValueError, match="which is not in"):
        clone_behaviour(model, Demonstrations(shown.observations, outside * np.float32(1.0001)))


def test_what_can_not_be_cloned_is_refused(env):
    shown = _made_up(env, lambda partial: partial[:, :1])
    recurrent = GAC("MultiInputGruPolicy", env, **SMALL | {"policy_kwargs": {"net_arch": [8], "rnn_hidden_size": 8}})
    with pytest.raises(ValueError, match="model has a memory"):
        clone_behaviour(recurrent, shown)
    with pytest.raises(ValueError, match="gradient_steps"):
        clone_behaviour(GAC("MultiInputPolicy", env, **SMALL), shown, gradient_steps=0)
    from stable_baselines3 import SAC

    with pytest.raises(TypeError, match=r"model must be of sb3_gac, got SAC\."):
        clone_behaviour(SAC("MultiInputPolicy", env, buffer_size=10), shown)


def test_an_independent_guider_starts_as_the_teacher(env):
    teacher = AsymmetricSAC("MultiInputPolicy", env, **SMALL, **FULL)
    model = GAC("MultiInputPolicy", env, **SMALL | {"seed": 5}, guider="independent")
    copy_networks(model, teacher, {"guider": "actor", "learner_critic": "critic"})
    observation = env.reset()
    guided, _ = model.predict_guider(observation, deterministic=True)
    taught, _ = teacher.predict(observation, deterministic=True)
    np.testing.assert_allclose(guided, taught, rtol=1e-6)
    expected = teacher.policy.critic.state_dict()
    for own in (model.policy.learner_critic, model.policy.learner_critic_target):
        assert all(th.equal(value, expected[name]) for name, value in own.state_dict().items())
    model.learn(60)
    still, _ = teacher.predict(observation, deterministic=True)
    np.testing.assert_array_equal(still, taught, err_msg="the teacher is not trained along")


def test_networks_of_another_noise_and_of_equal_settings_are_copied():
    """Sensor noise widens the bounds of a Box, which changes nothing."""
    clean, noisy = (make_vec("sb3_gac/Pendulum-v1", 1, 0, noise_std=noise) for noise in (0.0, 0.1))
    assert clean.observation_space != noisy.observation_space
    bounds = {"policy_kwargs": {"net_arch": [16], "log_std_bounds": [-5.0, 2.0]}}
    source = GAC("MultiInputPolicy", clean, **SMALL | bounds)
    bounds["policy_kwargs"]["log_std_bounds"] = (-5.0, 2.0)
    model = GAC("MultiInputPolicy", noisy, **SMALL | bounds | {"seed": 1})
    copy_networks(model, source, {"learner": "learner"})
    observation = {"partial": np.full(2, 0.3, np.float32)}
    copied, expected = (one.predict(observation, deterministic=True)[0] for one in (model, source))
    np.testing.assert_array_equal(copied, expected)


def test_networks_that_do_not_fit_are_refused_and_nothing_is_copied(env):
    teacher = AsymmetricSAC("MultiInputPolicy", env, **SMALL | {"policy_kwargs": {"net_arch": [8]}})
    model = GAC("MultiInputPolicy", env, **SMALL)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    with pytest.raises(
        ValueError, match=r'"actor" of AsymmetricSAC does not fit "learner" of GAC: .* \(8, 2\) there, and \(16, 2\)'
    ):
        copy_networks(model, teacher, {"learner": "actor"})
    other = GAC("MultiInputPolicy", env, **SMALL | {"policy_kwargs": {"net_arch": [16], "activation_fn": th.nn.ReLU}})
    with pytest.raises(
        ValueError, match=r'"learner" of GAC does not fit .* activation_fn is .*ReLU.* there, and .*SiLU.* here'
    ):
        copy_networks(model, other, {"learner": "learner"})
    other = GAC("MultiInputPolicy", env, **SMALL | {"policy_kwargs": {"net_arch": [16], "log_std_bounds": (-20.0, 2.0)}})
    with pytest.raises(ValueError, match=r"log_std_bounds is \(-20.0, 2.0\) there, and \(-5"):
        copy_networks(model, other, {"learner": "learner"})
    with pytest.raises(ValueError, match=r"networks: GAC has no network 'actor'; it has \['learner'"):
        copy_networks(model, teacher, {"actor": "actor"})
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())


@pytest.mark.parametrize("guider", ["residual", "lagged"])
def test_a_policy_of_its_own_and_a_correction_of_the_learner_are_not_taken_for_each_other(env, guider):
    """All shapes fit: the mean of one would become the other's distance from the learner."""
    teacher = AsymmetricSAC("MultiInputPolicy", env, **SMALL, **FULL)
    model = GAC("MultiInputPolicy", env, guider=guider, **SMALL | {"seed": 1})
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    with pytest.raises(ValueError, match=r"it is a policy of its own there, and relative to the deployed policy, .* here"):
        copy_networks(model, teacher, {"guider": "actor"})
    with pytest.raises(ValueError, match=r"it is relative to the deployed policy, .* there, and a policy of its own here"):
        copy_networks(teacher, model, {"actor": "guider"})
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())


@pytest.mark.parametrize("arguments", [{}, {"guider": "lagged"}, {"guider": "independent", "max_kl": 0.1}, GPOClip], ids=str)
def test_a_guider_relative_to_its_learner_is_copied_with_the_learner_alone(env, arguments):
    cls, arguments = (GAC, SMALL | arguments) if isinstance(arguments, dict) else (arguments, GPO)
    source, model = (cls("MultiInputPolicy", env, **arguments | {"seed": seed}) for seed in (0, 1))
    with pytest.raises(ValueError, match=r'relative to the "learner" there. Copy that too, by "learner": "learner"'):
        copy_networks(model, source, {"guider": "guider"})
    copy_networks(model, source, {"guider": "guider", "learner": "learner"})
    observation = env.reset()
    copied, expected = (one.predict_guider(observation, deterministic=True)[0] for one in (model, source))
    np.testing.assert_allclose(copied, expected, rtol=1e-6)
    copy_networks(model, source, {"guider": "guider"})  # the learners are equal by now


def test_networks_for_actions_of_another_range_are_refused():
    source, model = (GAC("MultiInputPolicy", TwoViewBandit(), guider="independent", **SMALL) for _ in range(2))
    model.action_space = spaces.Box(-20, 20, (1,), np.float32)
    with pytest.raises(ValueError, match=r"source was trained for actions in Box\(-1.* the model's are in Box\(-20"):
        copy_networks(model, source, {"learner": "learner"})


def test_networks_that_learned_on_another_scale_are_refused():
    source = small_model(VecNormalize(DummyVecEnv([TwoViewBandit]))).learn(20)
    with pytest.raises(ValueError, match=r'source was trained on an entry "partial" that was normalised .* env gives it raw'):
        copy_networks(small_model(), source, {"learner": "learner"})
    copy_networks(small_model(source.get_env()), source, {"learner": "learner"})


@pytest.mark.parametrize("name", ["AsymmetricMPO", "COSIL", "GACWithoutQ", "GPOPenalty", "RMA", "TGRL"])
def test_every_algorithm_can_be_taught(env, name):
    import sb3_gac

    teacher = AsymmetricSAC("MultiInputPolicy", env, **SMALL, **FULL)
    arguments = {"policy_kwargs": {"net_arch": [16]}, "seed": 0} | ({} if name == "GPOPenalty" else {"buffer_size": 500})
    model = getattr(sb3_gac, name)(
        "MultiInputPolicy", env, **arguments, **({"teacher": teacher} if name in ("COSIL", "TGRL") else {})
    )
    shown = _made_up(env, lambda partial: 2.0 * np.tanh(partial[:, :1]))
    if name == "RMA":
        with pytest.raises(ValueError, match="model has a memory"):
            clone_behaviour(model, shown)
    else:
        errors = clone_behaviour(model, shown, gradient_steps=200, batch_size=64, learning_rate=1e-2)
        assert errors["after"] < errors["before"] / 2


@pytest.mark.parametrize("who", ["teacher", "student"])
def test_whoever_learned_on_another_scale_is_refused(who):
    other = small_model(VecNormalize(DummyVecEnv([TwoViewBandit]))).learn(20)
    models = {"teacher": small_model().learn(20), "student": small_model().learn(20)} | {who: other}
    with pytest.raises(ValueError, match=f'{who} was trained on an entry "partial" that was normalised .* env gives it raw'):
        demonstrate(models["teacher"], DummyVecEnv([TwoViewBandit]), 10, student=models["student"])
