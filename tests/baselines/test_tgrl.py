"""TGRL: a teacher that stays as it is, two actors that take turns by episode, and a weight that follows their returns."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac import GAC, TGRL, AsymmetricSAC, OnnxPolicy, export_learner
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model

FULL = {"role_keys": {"actor": ["partial", "privileged"]}}


def make_teacher(env=None, cls=AsymmetricSAC, **arguments):
    arguments = (FULL if cls is AsymmetricSAC else {}) | arguments
    return small_model(TwoViewBandit() if env is None else env, cls, **arguments)


def make_student(env=None, teacher=None, **arguments):
    return small_model(env, TGRL, teacher=make_teacher(env) if teacher is None else teacher, **arguments)


def _observations(n=6):
    return {"partial": th.randn(n, 2), "privileged": th.randn(n, 1)}


def _same(one, other):
    return all(th.equal(p, q) for p, q in zip(one.parameters(), other.parameters(), strict=True))


# --- the teacher -----------------------------------------------------------------------------------------------------------


def test_the_teacher_stays_as_it_is_and_needs_no_optimiser():
    teacher = make_teacher().learn(20)
    before = deepcopy(teacher.policy)
    model = make_student(teacher=teacher).learn(60)
    assert _same(teacher.policy, before)
    assert set(model.policy.trained) == {"actor", "auxiliary", "reward_critic", "teacher_critic"}
    assert not any("teacher_policy" in name or "frozen" in name for name in model.get_parameters()["policy"])


@pytest.mark.parametrize("kind", [str, lambda path: path])
def test_a_teacher_may_be_the_path_of_one(kind, tmp_path):
    teacher = make_teacher().learn(20)
    teacher.save(tmp_path / "teacher.zip")
    models = [make_student(teacher=one).learn(40) for one in (teacher, kind(tmp_path / "teacher.zip"))]
    assert _same(models[0].policy, models[1].policy)


def test_a_teacher_acts_as_it_did_when_it_collected_its_data():
    obs = _observations()
    gac, sac = make_teacher(cls=GAC), make_teacher()
    with th.no_grad():
        assert th.equal(make_student(teacher=gac).frozen["teacher"](obs).mean, gac.policy.distributions(obs).guider.mean)
        assert th.equal(make_student(teacher=sac).frozen["teacher"](obs).mean, sac.policy.actor.distribution(obs).mean)
        theirs = SAC("MultiInputPolicy", TwoViewBandit(), policy_kwargs={"net_arch": [8]}, device="cpu")
        mean, log_std, _ = theirs.actor.get_action_dist_params(obs)
        asked = make_student(teacher=theirs).frozen["teacher"](obs)
        th.testing.assert_close((asked.mean, asked.log_std), (mean, log_std))


@pytest.mark.parametrize(
    ("teacher", "error", "message"),
    [
        (lambda: make_teacher(TwoViewChoice()), ValueError, "teacher was trained for actions in Discrete"),
        (lambda: make_teacher(Recall(continuous=True)), ValueError, 'teacher was trained on an entry "partial" that was Box'),
        (lambda: object(), TypeError, "teacher must be a model of sb3_gac"),
        (lambda: make_teacher(policy="MultiInputGruPolicy", policy_kwargs={}), ValueError, "teacher has a memory"),
    ],
)
def test_what_can_not_teach_is_refused(teacher, error, message):
    with pytest.raises(error, match=message):
        make_student(teacher=teacher())


class OfAnotherPackage(AsymmetricSAC):
    """Somebody's own."""


def test_a_path_may_be_of_somebodys_own_class(tmp_path):
    make_teacher(cls=OfAnotherPackage, **FULL).save(tmp_path / "teacher.zip")
    model = make_student(teacher=str(tmp_path / "teacher.zip"))
    assert model.frozen["teacher"].policy.role_keys["actor"] == ("partial", "privileged")


def test_a_file_that_is_no_model_of_the_package_is_named(tmp_path):
    SAC("MultiInputPolicy", TwoViewBandit(), device="cpu", buffer_size=10).save(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"sac.zip' is no model of a class that can be imported: pass the loaded"):
        make_student(teacher=str(tmp_path / "sac.zip"))


def test_to_train_takes_a_teacher_and_to_act_takes_none(tmp_path):
    make_teacher().save(tmp_path / "teacher.zip")
    model = make_student(teacher=str(tmp_path / "teacher.zip")).learn(30)
    model.save(tmp_path / "student")
    (tmp_path / "teacher.zip").rename(tmp_path / "moved.zip")
    robot = TGRL.load(tmp_path / "student")
    obs = {"partial": np.ones(2, np.float32)}
    np.testing.assert_array_equal(robot.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    with pytest.raises(FileNotFoundError, match=r"teacher.zip"):
        TGRL.load(tmp_path / "student", env=TwoViewBandit())
    again = TGRL.load(tmp_path / "student", env=TwoViewBandit(), teacher=str(tmp_path / "moved.zip"))
    assert again.learn(20, reset_num_timesteps=False).num_timesteps == 50
    with pytest.raises(ValueError, match=r"TGRL trains with a teacher: pass teacher=<a trained model or its path>"):
        small_model(cls=TGRL, teacher=None).learn(20)


# --- who acts, and what follows from it --------------------------------------------------------------------------------------


def test_the_actors_take_turns_by_episode_in_each_environment():
    model = make_student(DummyVecEnv([lambda n=n: TwoViewBandit(length=n) for n in (2, 3)]), make_teacher())
    seen = []
    model.on_step = lambda: seen.append(list(model.acting))
    model.learn(24)
    first, second = zip(*seen, strict=True)
    a, b = "auxiliary", "actor"
    assert first == (a, a, b, b, a, a, b, b, a, a, b, b)
    assert second == (a, a, a, b, b, b, a, a, a, b, b, b)


def test_each_actor_acts_in_its_own_episodes():
    model = make_student(learning_starts=0, gradient_steps=0)
    with th.no_grad():
        for role, sign in (("actor", 50.0), ("auxiliary", -50.0)):
            getattr(model.policy, role).head.mean.bias.fill_(sign)
    ends = []
    model.on_episode_end = lambda env, episode_return, role: ends.append(role)
    model.learn(6)
    actions = model.replay_buffer.sample(200).actions
    assert {round(float(a)) for a in actions} == {-1, 1}
    assert ends == ["auxiliary", "actor"] * 3


def test_episodes_of_the_warm_up_are_nobodys():
    model = make_student(learning_starts=4, window=100)
    model.learn(10)
    assert {role: len(returns) for role, returns in model.returns.items()} == {"actor": 3, "auxiliary": 3}


@pytest.mark.parametrize(
    ("main", "auxiliary", "expected"),
    [([1.0, 3.0], [1.5], 0.51), ([1.0], [1.0, 2.0], 0.49), ([1.0], [1.0], 0.5), ([], [1.0], 0.5), ([1.0], [], 0.5)],
)
def test_the_weight_follows_the_mean_returns(main, auxiliary, expected):
    model = make_student(teacher_coef=0.5, compare_every=100)
    model.set_logger(make_teacher().learn(1).logger)
    model.returns.update(actor=main, auxiliary=auxiliary)
    for model.num_timesteps in (99, 100, 101, 199):  # one comparison
        model.on_step()
    assert model.coefficients["teacher_coef"].value.item() == pytest.approx(expected)


def test_the_weight_stays_above_zero_and_is_compared_at_each_interval():
    model = make_student(teacher_coef=0.015, compare_every=10)
    model.set_logger(make_teacher().learn(1).logger)
    model.returns.update(actor=[0.0], auxiliary=[1.0])
    values = []
    for model.num_timesteps in (12, 18, 24, 30, 36):  # three environments wide, past 10, 20, 30 and not yet 40
        model.on_step()
        values.append(model.coefficients["teacher_coef"].value.item())
    assert values == pytest.approx([0.005, 0.005, 0.0, 0.0, 0.0])
    model.returns.update(actor=[2.0])
    model.num_timesteps = 40
    model.on_step()
    assert model.coefficients["teacher_coef"].value.item() == pytest.approx(0.01)


# --- promises ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_path", [True, False])
def test_resumed_it_is_the_same_to_the_bit(as_path, tmp_path):
    """With its weight, its returns and whose turn it is, in the middle of an episode."""
    teacher = make_teacher().learn(20)
    teacher.save(tmp_path / "teacher.zip")
    given = str(tmp_path / "teacher.zip") if as_path else teacher

    def make():
        return make_student(TwoViewBandit(length=4), given, compare_every=10, coef_step=0.1)

    through, stopped = make().learn(107), make().learn(63)
    stopped.save_checkpoint(tmp_path / "checkpoints")
    if not as_path:
        with pytest.raises(ValueError, match=r"can hold these arguments.*teacher \(it is a model, and not the path"):
            TGRL.resume(tmp_path / "checkpoints", TwoViewBandit(length=4), device="cpu")
    again = {} if as_path else {"teacher": teacher}
    resumed = TGRL.resume(tmp_path / "checkpoints", TwoViewBandit(length=4), device="cpu", **again)
    resumed.learn(44, reset_num_timesteps=False)
    assert _same(resumed.policy, through.policy)
    assert resumed.returns == through.returns
    assert (resumed.acting, resumed.next_comparison) == (through.acting, through.next_comparison)
    weights = [model.coefficients["teacher_coef"].value for model in (resumed, through)]
    assert weights[0] == weights[1] != 1.0


def test_saved_and_loaded_it_has_its_weight_and_goes_on(tmp_path):
    make_teacher().save(tmp_path / "teacher.zip")
    model = make_student(TwoViewBandit(length=2), str(tmp_path / "teacher.zip"), compare_every=10, coef_step=0.1).learn(60)
    model.save(tmp_path / "model")
    loaded = TGRL.load(tmp_path / "model", env=TwoViewBandit(length=2))
    assert loaded.coefficients["teacher_coef"].value == model.coefficients["teacher_coef"].value != 1.0
    assert loaded.returns == model.returns
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 80


def test_exported_it_acts_as_predict_does(tmp_path):
    model = make_student().learn(40)
    robot = OnnxPolicy.load(export_learner(model, tmp_path / "student.onnx", verify_on=8))
    obs = np.random.default_rng(0).standard_normal((5, 2)).astype(np.float32)
    np.testing.assert_allclose(robot.act(obs), model.predict({"partial": obs}, deterministic=True)[0], atol=1e-5)


@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MultiInputGruPolicy", "MultiInputLstmPolicy"])
@pytest.mark.parametrize("env", [Recall, lambda: Recall(continuous=True)])
def test_students_of_every_kind_train(env, policy):
    sizes = {} if policy == "MultiInputPolicy" else {"rnn_hidden_size": 8, "rnn_net_arch": [8]}
    model = make_student(env(), policy=policy, policy_kwargs={"net_arch": [8], **sizes}, batch_size=4).learn(60)
    logged = {name: value for name, value in model.logger.name_to_value.items() if name.startswith("train/")}
    assert np.isfinite(list(logged.values())).all()
    assert {"train/kl_to_teacher", "train/teacher_coef", "train/auxiliary_loss"} <= set(logged)


def test_the_actors_see_what_is_partial_alone():
    model = make_student()
    assert {role: keys for role, keys in model.policy.role_keys.items() if "critic" not in role} == {
        "actor": ("partial",),
        "auxiliary": ("partial",),
    }
    model = make_student(role_keys={"actor": ["partial", "privileged"]})
    assert model.policy.role_keys["auxiliary"] == ("partial", "privileged"), "unless both are told to"


def test_the_student_follows_a_good_teacher():
    """What the teacher knows can be seen: near it is near the optimum, long before the reward alone shows the way."""

    class Silent(TwoViewBandit):
        """No reward tells anything."""

        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, 0.0, *rest

    teacher = make_teacher(learning_rate=3e-3, batch_size=64, learning_starts=100).learn(800)
    model = make_student(Silent(), teacher, learning_rate=3e-3, batch_size=64, learning_starts=50, ent_coef=0.0).learn(500)
    targets = np.linspace(-0.7, 0.7, 15, dtype=np.float32)
    partial = np.stack([targets, np.zeros(15, np.float32)], axis=1)
    of_teacher, _ = teacher.predict({"partial": partial, "privileged": targets[:, None]}, deterministic=True)
    of_student, _ = model.predict({"partial": partial}, deterministic=True)
    assert np.abs(of_teacher[:, 0] - targets).mean() < 0.15, "the teacher knows"
    assert np.abs(of_student - of_teacher).mean() < 0.15
