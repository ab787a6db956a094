"""COSIL: a student near a teacher that sees more, a weight that holds it there, and no entropy."""

from types import MappingProxyType

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_gac import COSIL, TGRL, AsymmetricSAC
from sb3_gac.base.batch import Batch
from sb3_gac.math.distributions import Categorical, TanhGaussian
from sb3_gac.networks.heads import resolve_target_divergence
from tests.helpers import Recall, Sampled, TwoViewBandit, TwoViewChoice, small_model

IMAGES = spaces.Dict(partial=spaces.Box(0, 255, (3, 36, 36), np.uint8), privileged=spaces.Box(-1, 1, (2,), np.float32))
SMALL_CNN = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
MEMORY = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}
GRU = {"policy": "MultiInputGruPolicy", "policy_kwargs": MEMORY, "batch_size": 4}
LSTM = GRU | {"policy": "MultiInputLstmPolicy"}


def make_teacher(env=None, **arguments):
    return small_model(env, AsymmetricSAC, role_keys={"actor": ["partial", "privileged"]}, seed=1, **arguments)


def make_student(env=None, teacher=None, **arguments):
    return small_model(env, COSIL, teacher=make_teacher(env) if teacher is None else teacher, **arguments)


def _same(one, other):
    return all(th.equal(p, q) for p, q in zip(one.policy.parameters(), other.policy.parameters(), strict=True))


# --- the limit: without a weight it is SAC on what the student sees, without entropy -------------------------------------

LIMITS = {
    "numbers": (TwoViewBandit, {}),
    "choices": (TwoViewChoice, {}),
    "n steps, clipped": (lambda: TwoViewBandit(length=5), {"n_steps": 3, "max_grad_norm": 0.01}),
    "images": (lambda: Sampled(IMAGES), {"policy_kwargs": SMALL_CNN}),
    "GRU": (Recall, GRU),
    "LSTM, numbers": (lambda: Recall(continuous=True), LSTM),
}


def _pair(kind, weight, critic=("partial",)):
    make_env, arguments = LIMITS[kind]
    teacher = make_teacher(make_env(), **{"policy_kwargs": SMALL_CNN} if kind == "images" else {})
    keys = {"role_keys": {"critic": list(critic)}}
    student = make_student(make_env(), teacher, teacher_coef=weight, **arguments)
    return student.learn(60), small_model(make_env(), AsymmetricSAC, ent_coef=0.0, **keys, **arguments).learn(60)


@pytest.mark.parametrize("kind", LIMITS)
def test_with_weight_zero_it_is_sac_without_entropy_on_the_students_view(kind):
    """To the bit, whole trainings."""
    student, sac = _pair(kind, weight=0.0)
    assert student._n_updates == sac._n_updates > 0
    assert _same(student, sac)


def test_it_is_the_weight_and_the_critics_view_that_make_it_so():
    assert not _same(*_pair("numbers", weight=1e-3))
    student, sac = _pair("numbers", weight=0.0, critic=("partial", "privileged"))
    assert sum(p.numel() for p in student.policy.critic.parameters()) < sum(p.numel() for p in sac.policy.critic.parameters())


# --- a task of two states, worked out -----------------------------------------------------------------------------------

GAMMA, WEIGHT = 0.6, 0.3
#: By state, by what only the teacher sees, by action
REWARDS = np.array([[[0.2, 1.0], [0.4, 0.2]], [[0.9, 0.1], [0.3, 0.3]]])
LOGITS = np.array([[[1.2, 0.0], [0.0, 0.4]], [[0.0, 1.5], [-0.5, 0.5]]])


TWO_STATES = spaces.Dict(partial=spaces.Box(0, 1, (2,), np.float32), privileged=spaces.Box(0, 1, (1,), np.float32))


def _every_transition():
    """The action is the next state; a coin that is privileged is tossed in every step, and counts for reward and teacher."""
    states, coins, actions, later_coins = th.cartesian_prod(*[th.arange(2)] * 4).T
    now, later = (
        {"partial": th.nn.functional.one_hot(state).float(), "privileged": coin[:, None].float()}
        for state, coin in ((states, coins), (actions, later_coins))
    )
    rewards = th.tensor(REWARDS, dtype=th.float32)[states, coins, actions]
    return Batch(now, actions[:, None], rewards, later, th.zeros(16), th.tensor(GAMMA))


class Known:
    """A teacher in the place of a frozen policy, which was trained on nothing."""

    entries, scales = (), MappingProxyType({})

    def __init__(self, distribution):
        self.distribution = distribution

    def __call__(self, obs):
        return self.distribution(obs)


def _known_teacher(obs):
    return Categorical(th.tensor(LOGITS, dtype=th.float32)[obs["partial"].argmax(-1), obs["privileged"][..., 0].long()])


def _optimum(weight):
    """
    The fixed point of Q = E r + gamma V and V = max over pi of pi Q - weight E KL(pi || teacher), E over the coin: pi is
    proportional to the geometric mean of the teacher's probabilities, times exp(Q / weight).
    """
    log_teacher = LOGITS - np.log(np.exp(LOGITS).sum(axis=-1, keepdims=True))
    log_mean, value = log_teacher.mean(axis=1), np.zeros(2)
    for _ in range(200):
        q = REWARDS.mean(axis=1) + GAMMA * value[None]
        unnormalised = np.exp(log_mean + q / weight)
        value = weight * np.log(unnormalised.sum(axis=-1))
    policy = unnormalised / unnormalised.sum(axis=-1, keepdims=True)
    divergence = (policy[:, None] * (np.log(policy)[:, None] - log_teacher)).sum(axis=-1).mean(axis=1)
    return q, policy, divergence


def _trained_on_two_states(**arguments):
    model = small_model(Sampled(TWO_STATES, spaces.Discrete(2)), COSIL, learning_rate=1e-2, tau=0.1, **arguments)
    model.frozen["teacher"] = Known(_known_teacher)
    model.learn(1)
    batch = _every_transition()
    model._sample_batch = lambda batch_size: batch
    model.train(gradient_steps=250)
    states = {"partial": th.eye(2), "privileged": th.zeros(2, 1)}
    with th.no_grad():
        q = model.policy.critic.values(model.policy.critic.encode(states), None).mean(dim=0)
        return model, q.numpy(), model.policy.actor.distribution(states).logits.softmax(-1).numpy()


def test_of_two_states_it_finds_values_and_policy():
    q, policy, divergence = _optimum(WEIGHT)
    _, found_q, found_policy = _trained_on_two_states(teacher_coef=WEIGHT)
    np.testing.assert_allclose(found_q, q, atol=1e-3)
    np.testing.assert_allclose(found_policy, policy, atol=1e-3)
    assert (GAMMA * WEIGHT * divergence).min() > 0.02, "or the target's divergence would not show"
    assert np.abs(policy - _optimum(100.0)[1]).min() > 0.1, "the teacher alone is another one"


def test_of_two_states_it_finds_the_weight_that_holds_the_target():
    """Both states are equally frequent in the mean over which D is held."""
    divergence = _optimum(WEIGHT)[2].mean()
    model, _, _ = _trained_on_two_states(target_divergence=divergence, teacher_coef_learning_rate=2e-2)
    assert model.coefficients["teacher_coef"].value.item() == pytest.approx(WEIGHT, abs=2e-3)


# --- the weight ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("target", "factor"), [(0.0, np.exp(0.1)), (1e6, np.exp(-0.1))])
def test_the_weight_rises_exactly_while_the_divergence_is_above_its_target(target, factor):
    """Adam's first step is as long as its learning rate."""
    rules = {"target_divergence": target, "teacher_coef": "auto_0.5", "teacher_coef_learning_rate": 0.1}
    model = make_student(learning_starts=20, **rules).learn(21)
    assert model._n_updates == 1
    assert model.coefficients["teacher_coef"].value.item() == pytest.approx(0.5 * factor, rel=1e-4)


def test_the_weight_is_what_was_written():
    for given, value in (("auto", 1.0), ("auto_0.2", 0.2), (0.3, 0.3), (0, 0.0)):
        assert make_student(teacher_coef=given).coefficients["teacher_coef"].value.item() == pytest.approx(value)
    bounds = {"teacher_coef_bounds": (1.5, 2.0), "teacher_coef_learning_rate": 1.0}
    model = make_student(teacher_coef="auto_2", target_divergence=1e6, **bounds).learn(15)
    assert model.coefficients["teacher_coef"].value.item() == pytest.approx(1.5)
    assert model.logger.name_to_value["train/teacher_coef_on_bound"] == 1.0


def test_the_target_by_itself_grows_with_what_there_is_to_choose():
    box = spaces.Box(-1, 1, (3, 2), np.float32)
    assert resolve_target_divergence("auto", box) == 3.0
    assert resolve_target_divergence("auto", spaces.Discrete(5)) == pytest.approx(0.5 * np.log(5))
    assert resolve_target_divergence(0.7, box) == 0.7
    mean, log_std = th.zeros(1), th.zeros(1)
    off_by_a_std = TanhGaussian(mean + 1.0, log_std).kl(TanhGaussian(mean, log_std))
    assert off_by_a_std.item() == resolve_target_divergence("auto", spaces.Box(-1, 1, (1,), np.float32))


@pytest.mark.parametrize("how", ["load", "resume"])
@pytest.mark.parametrize("cls", [COSIL, TGRL])
def test_a_weight_that_is_given_to_a_file_counts(cls, how, tmp_path):
    teacher = make_teacher()
    model = small_model(None, cls, teacher=teacher, teacher_coef=0.5).learn(20)
    model.save(tmp_path / "model")
    model.save_checkpoint(tmp_path / "checkpoints")
    for given, expected in (({}, 0.5), ({"teacher_coef": 0.8}, 0.8)):
        if how == "load":
            again = cls.load(tmp_path / "model", TwoViewBandit(), teacher=teacher, device="cpu", **given)
        else:
            again = cls.resume(tmp_path / "checkpoints", TwoViewBandit(), teacher=teacher, device="cpu", **given)
        assert again.coefficients["teacher_coef"].value.item() == pytest.approx(expected)


def test_a_learned_weight_goes_on_from_where_it_was_with_other_rates_and_bounds(tmp_path):
    model = make_student(teacher_coef_learning_rate=0.05).learn(30)
    model.save(tmp_path / "model")
    again = COSIL.load(tmp_path / "model", teacher_coef_learning_rate=0.5, teacher_coef_bounds=(0.01, 1e3), device="cpu")
    before, after = (one.coefficients["teacher_coef"] for one in (model, again))
    assert after.value == before.value != 1.0
    assert after.optimizer.param_groups[0]["lr"] == 0.5


# --- what it does not have ----------------------------------------------------------------------------------------------


class WithoutCoefficients(AsymmetricSAC):
    """Of somebody else."""

    def make_coefficients(self):
        return {}


@pytest.mark.parametrize(("name", "value"), [("ent_coef", 0.1), ("ent_coef", "auto_0.5"), ("target_entropy", -3.0)])
@pytest.mark.parametrize("cls", [COSIL, WithoutCoefficients])
def test_an_argument_of_the_entropy_that_would_do_nothing_is_refused(cls, name, value, tmp_path):
    message = f"{cls.__name__} has no entropy term, so {name} would do nothing: leave it out, got {value!r}"
    with pytest.raises(ValueError, match=message):
        small_model(None, cls, **{name: value})
    small_model(None, cls, ent_coef="auto", target_entropy="auto").save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        cls.load(tmp_path / "model", **{name: value})
    assert cls.load(tmp_path / "model", TwoViewBandit()).target_entropy == -0.5, "what it was by default"


# --- who sees what ------------------------------------------------------------------------------------------------------


def test_critics_see_what_the_student_sees_unless_they_are_told_to_see_more():
    keys = make_student().policy.role_keys
    assert keys == {"actor": ("partial",), "critic": ("partial",)}
    keys = make_student(role_keys={"critic": ["partial", "privileged"]}).policy.role_keys
    assert keys == {"actor": ("partial",), "critic": ("partial", "privileged")}
    assert make_student(role_keys={"actor": ["privileged"]}).policy.role_keys["critic"] == ("privileged",)
    assert all(network.memory is not None for network in make_student(Recall(), **GRU).policy.pairs["critic"])


def test_the_teacher_is_asked_about_everything_and_stays_as_it_is():
    teacher = make_teacher().learn(20)
    before = [p.detach().clone() for p in teacher.policy.parameters()]
    one, other = (make_student(teacher=teacher, teacher_coef=1.0) for _ in range(2))
    for key in ("partial", "privileged"):
        obs = {"partial": th.zeros(4, 2), "privileged": th.zeros(4, 1)}
        assert not th.equal(one.frozen["teacher"](obs).mean, one.frozen["teacher"](obs | {key: obs[key] + 1}).mean)
    with th.no_grad():
        for p in other.frozen["teacher"].parameters():
            p.add_(0.5)
    one.learn(40), other.learn(40)
    assert all(th.equal(p, q) for p, q in zip(teacher.policy.parameters(), before, strict=True))
    assert not _same(one, other)


def test_training_takes_a_teacher_and_acting_takes_none(tmp_path):
    model = make_student().learn(20)
    model.save(tmp_path / "student")
    robot, obs = COSIL.load(tmp_path / "student"), {"partial": np.ones(2, np.float32)}
    np.testing.assert_array_equal(robot.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    with pytest.raises(ValueError, match="COSIL trains with a teacher: pass teacher="):
        small_model(None, COSIL, teacher=None).learn(20)


# --- all of it together -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["images", "LSTM, numbers"])
def test_it_trains_and_logs_what_it_holds(kind):
    make_env, arguments = LIMITS[kind]
    teacher = make_teacher(make_env(), **{"policy_kwargs": SMALL_CNN} if kind == "images" else {})
    model = make_student(make_env(), teacher, **arguments).learn(40)
    logged = {name: value for name, value in model.logger.name_to_value.items() if name.startswith("train/")}
    assert np.isfinite(list(logged.values())).all()
    assert {"train/divergence", "train/teacher_coef", "train/teacher_coef_loss", "train/critic_q"} <= set(logged)
    assert not {"train/ent_coef", "train/entropy"} & set(logged)


@pytest.mark.parametrize("kind", ["numbers", "GRU"])
def test_it_resumes_to_the_bit(kind, tmp_path):
    make_env, arguments = LIMITS[kind]
    teacher = make_teacher(make_env())
    whole = make_student(make_env(), teacher, **arguments).learn(40).learn(40, reset_num_timesteps=False)
    make_student(make_env(), teacher, **arguments).learn(40).save_checkpoint(tmp_path)
    again = COSIL.resume(tmp_path, make_env(), teacher=teacher, device="cpu").learn(40, reset_num_timesteps=False)
    assert _same(whole, again)
    for (name, one), other in zip(whole.get_parameters().items(), again.get_parameters().values(), strict=True):
        th.testing.assert_close(one, other, rtol=0, atol=0, msg=name)


def test_a_student_of_a_good_teacher_needs_no_reward():
    """What the teacher knows can be seen: near it is near the optimum."""

    class Silent(TwoViewBandit):
        """No reward tells anything."""

        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, 0.0, *rest

    model = small_model(Silent(), COSIL, learning_rate=1e-2, batch_size=64, learning_starts=50)
    model.frozen["teacher"] = Known(
        lambda obs: TanhGaussian(th.atanh(obs["privileged"]), th.full_like(obs["privileged"], -1.0))
    )
    model.learn(300)
    targets = np.linspace(-0.7, 0.7, 15, dtype=np.float32)
    actions, _ = model.predict({"partial": np.stack([targets, np.zeros(15, np.float32)], axis=1)}, deterministic=True)
    assert np.abs(actions[:, 0] - targets).mean() < 0.1
