"""TGRL's own rules: how the teacher's weight moves, who collects, who sees what, and which teachers there are."""

import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import COSIL, GAC, TGRL, AsymmetricSAC
from sb3_gac.base.frozen import FrozenPolicy, load_frozen_policy
from tests.helpers import Recall, Sampled, TwoViewBandit, TwoViewChoice, small_model, unlike_each_other

FULL = {"role_keys": {"actor": ["partial", "privileged"]}}


def _teacher(env=None, cls=AsymmetricSAC, **arguments):
    return small_model(env, cls, **(FULL if cls is AsymmetricSAC else {}) | arguments)


def _model(env=None, **arguments):
    return small_model(env, TGRL, **{"teacher": _teacher(), "coef_step": 0.1, "compare_every": 10, **arguments})


# --- the teacher's weight ---------------------------------------------------------------------------------------------


def _after(model, steps, **returns):
    model.num_timesteps = steps
    for role, values in returns.items():
        for episode_return in values:
            model.on_episode_end(0, episode_return, role)
    model.on_step()
    return model.coefficients["teacher_coef"].value.item()


@pytest.fixture
def model():
    model = _model(teacher_coef=1.0, window=3)
    model._setup_learn(100)  # which gives it a logger
    return model


@pytest.mark.parametrize(("main", "auxiliary", "weight"), [(2.0, 1.0, 1.1), (1.0, 2.0, 0.9), (1.0, 1.0, 1.0)])
def test_the_weight_rises_where_the_main_actors_episodes_are_the_better_ones(model, main, auxiliary, weight):
    """By one step, whatever the distance."""
    assert _after(model, 10, actor=[main * 100], auxiliary=[auxiliary * 100]) == pytest.approx(weight)
    assert model.logger.name_to_value["rollout/main_minus_auxiliary"] == 100 * (main - auxiliary)


@pytest.mark.parametrize("returns", [{"actor": [1.0]}, {"auxiliary": [1.0]}, {}])
def test_nothing_is_compared_with_nothing(model, returns):
    assert _after(model, 10, **returns) == 1.0


def test_the_latest_episodes_alone_are_compared(model):
    """As many as the window holds, of each actor: their mean."""
    assert _after(model, 10, actor=[100.0, 0.0, 0.0, 2.0], auxiliary=[-100.0, 1.0, 1.0, 1.0]) == pytest.approx(0.9)
    assert _after(model, 20, auxiliary=[-9.0]) == pytest.approx(1.0)
    assert len(model.returns["actor"]) == 3


def test_more_episodes_are_not_better_ones(model):
    assert _after(model, 10, actor=[1.0, 1.0, 1.0], auxiliary=[1.5]) == pytest.approx(0.9)


def test_it_is_compared_now_and_then_and_not_twice_for_a_step_over_several(model):
    episodes = {"actor": [1.0], "auxiliary": [0.0]}
    assert _after(model, 9, **episodes) == 1.0
    assert _after(model, 10) == pytest.approx(1.1)
    assert _after(model, 11) == _after(model, 19) == pytest.approx(1.1)
    assert _after(model, 43) == pytest.approx(1.2)
    assert _after(model, 49) == pytest.approx(1.2)
    assert _after(model, 50) == pytest.approx(1.3)


def test_it_does_not_fall_below_zero(model):
    weights = [_after(model, 10 * step, actor=[0.0], auxiliary=[1.0]) for step in range(1, 14)]
    assert weights[:2] == pytest.approx([0.9, 0.8])
    assert weights[-1] == 0.0
    assert _after(model, 200, actor=[9.0]) == pytest.approx(0.1)


def test_what_was_gathered_is_in_checkpoints(tmp_path):
    model = _model(TwoViewBandit(length=3), learning_starts=0, window=4).learn(25)
    assert model.next_comparison == 30
    assert all(len(returns) == 4 for returns in model.returns.values())
    model.save_checkpoint(tmp_path)
    again = TGRL.resume(tmp_path, TwoViewBandit(length=3), device="cpu", teacher=model.teacher)
    assert again.returns == model.returns
    assert again.next_comparison == 30
    assert again.coefficients["teacher_coef"].value.item() == model.coefficients["teacher_coef"].value.item()


# --- who collects -----------------------------------------------------------------------------------------------------


def _roles_of_episodes(model, steps):
    ended = [[] for _ in range(model.n_envs)]
    model.on_episode_end = lambda env, episode_return, role: ended[env].append(role)
    model.learn(steps)
    return ended


def test_actors_take_turns_by_episode_in_each_environment():
    env = DummyVecEnv([lambda length=length: TwoViewBandit(length=length) for length in (3, 5)])
    ended = _roles_of_episodes(_model(env, learning_starts=0), 60)
    assert [len(roles) for roles in ended] == [10, 6]
    for roles in ended:
        assert set(roles[::2]) | set(roles[1::2]) == {"actor", "auxiliary"}
        assert len(set(roles[::2])) == len(set(roles[1::2])) == 1


def test_an_actor_stays_to_its_episodes_end(model):
    model.acting = ["actor", "auxiliary", "actor", "auxiliary"]
    assert model.choose_acting(np.array([False, False, True, True])) == ["actor", "auxiliary", "auxiliary", "actor"]


IDLE = "teacher's weight stays as it is, since .* behaviour gives none to"


@pytest.mark.filterwarnings(f"ignore:The {IDLE} actor")
def test_whoever_is_told_to_collect_does():
    ended = _roles_of_episodes(_model(TwoViewBandit(length=3), learning_starts=0, behaviour="auxiliary"), 12)
    assert ended == [["auxiliary"] * 4]


@pytest.mark.parametrize(
    ("behaviour", "idle"),
    [
        ("actor", "auxiliary:"),
        ({"teacher": "linear 1 -> 0"}, "auxiliary:"),
        ({"teacher": 1.0}, "actor and auxiliary:"),
        ({"auxiliary": "linear 0 -> 0.5"}, None),
        (None, None),
    ],
)
def test_a_weight_that_can_not_move_is_told(behaviour, idle):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = _model(behaviour=behaviour)
        _model(behaviour="actor", coef_step=0.0)
    said = [str(one.message) for one in caught if "teacher's weight" in str(one.message)]
    assert len(said) == bool(idle)
    assert all(f"behaviour gives none to {idle} give each" in one for one in said)
    model.behaviour = None  # from here on they take turns
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        model.follow_arguments()


def test_steps_in_between_would_be_missing():
    with pytest.raises(ValueError, match="n_steps must be 1 for TGRL, which needs the KL of every step, got 3"):
        _model(n_steps=3)


@pytest.mark.filterwarnings(f"ignore:The {IDLE} actor and auxiliary")
def test_actors_take_turns_after_a_teacher_that_collected():
    model = _model(TwoViewBandit(length=3), learning_starts=0, behaviour={"teacher": 1.0}).learn(4)
    assert model.acting == ["teacher"]
    model.behaviour = None
    ended = []
    model.on_episode_end = lambda env, episode_return, role: ended.append(role)
    model.learn(11, reset_num_timesteps=False)
    assert ended == ["teacher", "actor", "auxiliary", "actor"], "the teacher ends the episode that it has begun"


def test_episodes_of_warm_up_are_not_compared():
    model = _model(TwoViewBandit(length=3), learning_starts=10).learn(12)
    assert not any(model.returns.values())
    model.learn(9, reset_num_timesteps=False)
    assert sorted(len(returns) for returns in model.returns.values()) == [1, 2]


# --- who sees what ----------------------------------------------------------------------------------------------------


def test_both_actors_see_what_is_deployed_and_critics_see_all():
    keys = _model().policy.role_keys
    assert keys["actor"] == keys["auxiliary"] == ("partial",)
    assert keys["reward_critic"] == keys["teacher_critic"] == ("partial", "privileged")
    keys = _model(role_keys={"actor": ["privileged"]}).policy.role_keys
    assert keys["auxiliary"] == ("privileged",)
    keys = _model(role_keys={"auxiliary": ["partial", "privileged"]}).policy.role_keys
    assert (keys["actor"], keys["auxiliary"]) == (("partial",), ("partial", "privileged"))


@pytest.mark.parametrize("role", ["actor", "auxiliary"])
def test_the_teacher_is_asked_and_moves_nothing_of_itself(role):
    model = _model(learning_starts=0)
    teacher = model.teacher.policy
    unlike_each_other(teacher)
    before = [p.detach().clone() for p in teacher.parameters()]
    start = [p.detach().clone() for p in getattr(model.policy, role).parameters()]
    model.learn(12)
    assert all(th.equal(p, q) for p, q in zip(teacher.parameters(), before, strict=True))
    assert any(not th.equal(p, q) for p, q in zip(getattr(model.policy, role).parameters(), start, strict=True))


# --- teachers ---------------------------------------------------------------------------------------------------------


def _obs(model, n=5):
    space = model.observation_space
    return {key: th.as_tensor(np.stack([entry.sample() for _ in range(n)])) for key, entry in space.spaces.items()}


def test_the_teacher_is_the_policy_that_collected():
    """A guider acts relative to its learner."""
    teacher = _teacher(cls=GAC)
    unlike_each_other(teacher.policy)
    obs = _obs(teacher)
    asked, distributions = FrozenPolicy(teacher)(obs), teacher.policy.distributions(obs)
    th.testing.assert_close(asked, distributions.guider.detach())
    assert not th.allclose(asked.mean, distributions.learner.mean)
    assert not any(part.requires_grad for part in asked)


def test_sb3s_own_may_teach():
    teacher = SAC("MultiInputPolicy", TwoViewBandit(), device="cpu", policy_kwargs={"net_arch": [8]}, learning_starts=4)
    teacher.learn(12)
    with th.no_grad():
        teacher.actor.log_std.bias.add_(4.0)  # beyond its bound
    obs = _obs(teacher)
    mean, log_std, _ = teacher.actor.get_action_dist_params(obs)
    asked = FrozenPolicy(teacher)(obs)
    th.testing.assert_close(asked.mean, mean.detach())
    th.testing.assert_close(asked.log_std, log_std.detach())


@pytest.mark.parametrize("cls", [AsymmetricSAC, GAC])
def test_a_model_that_has_taught_may_train_on_and_what_is_asked_stays(cls):
    teacher = _teacher(cls=cls, learning_rate=0.1)
    frozen, obs = FrozenPolicy(teacher), _obs(teacher)
    assert not any(p.requires_grad for p in frozen.parameters())
    before = frozen(obs)
    start = [p.detach().clone() for p in teacher.policy.deployed.parameters()]
    teacher.learn(15)
    assert all(not th.equal(p, q) for p, q in zip(teacher.policy.deployed.parameters(), start, strict=True))
    th.testing.assert_close(frozen(obs), before, rtol=0, atol=0)


def _asked(teacher, env):
    return load_frozen_policy(teacher, env.observation_space, env.action_space, th.device("cpu"))


def _with_entry(space, action_space=None, key="partial"):
    entries = {"partial": spaces.Box(-np.inf, np.inf, (2,), np.float32), "privileged": spaces.Box(-1, 1, (1,), np.float32)}
    return Sampled(spaces.Dict({**entries, key: space}), action_space)


def test_a_teacher_that_was_trained_on_other_spaces_is_refused_by_name():
    teacher = _teacher()
    with pytest.raises(ValueError, match=r'teacher was trained on an entry "privileged" that was .* here it is'):
        _asked(teacher, _with_entry(spaces.Box(-2, 2, (1,), np.float32), key="privileged"))
    with pytest.raises(ValueError, match=r'teacher was trained on an entry "more" .* here it is missing'):
        _asked(_teacher(_with_entry(spaces.Discrete(3), key="more")), TwoViewBandit())
    with pytest.raises(ValueError, match="teacher was trained for actions in"):
        _asked(teacher, TwoViewChoice())
    with pytest.raises(ValueError, match="teacher was trained for actions in"):
        _asked(teacher, _with_entry(spaces.Discrete(2), spaces.Box(-2, 2, (1,), np.float32), key="more"))
    obs = {"partial": th.zeros(2, 2), "privileged": th.zeros(2, 1), "more": th.zeros(2, 1)}
    assert _asked(teacher, _with_entry(spaces.Discrete(2), key="more"))(obs).mean.shape == (2, 1), "more is no fault"


def test_what_can_be_asked_nothing_is_refused(tmp_path):
    memory = {"net_arch": [8], "rnn_hidden_size": 4, "rnn_net_arch": [8]}
    remembers = _teacher(Recall(), policy="MultiInputGruPolicy", policy_kwargs=memory)
    with pytest.raises(ValueError, match="teacher has a memory"):
        FrozenPolicy(remembers)
    with pytest.raises(TypeError, match="teacher must be a model"):
        FrozenPolicy(type("Other", (), {"policy": None})())
    SAC("MultiInputPolicy", TwoViewBandit(), device="cpu").save(tmp_path / "sac")
    with pytest.raises(ValueError, match="is no model of a class that can be imported"):
        _asked(tmp_path / "sac", TwoViewBandit())


def test_a_teacher_by_its_path_is_the_same_one(tmp_path):
    teacher = _teacher()
    unlike_each_other(teacher.policy)
    teacher.save(tmp_path / "teacher")
    obs = _obs(teacher)
    th.testing.assert_close(_asked(tmp_path / "teacher.zip", TwoViewBandit())(obs), FrozenPolicy(teacher)(obs))


def test_training_needs_a_teacher_and_acting_does_not():
    model = small_model(cls=TGRL, teacher=None)
    model.predict(TwoViewBandit().reset(seed=0)[0])
    with pytest.raises(ValueError, match="TGRL trains with a teacher"):
        model.learn(5)


def test_it_is_compared_in_a_second_training_from_the_start(model):
    """Which counts its steps from 0 again, unless it is told not to."""
    moments = []
    model.compare = lambda difference: moments.append(model.num_timesteps)
    for steps in [*range(4, 100, 4), *range(4, 40, 4)]:
        _after(model, steps, actor=[1.0], auxiliary=[0.0])
    assert moments == [12, 20, 32, 40, 52, 60, 72, 80, 92, 12, 20, 32]


def test_no_actor_acts_on_a_recording():
    with pytest.raises(ValueError, match="TGRL compares its actors' episodes, but no actor acts on a recording"):
        _model(recording="other.npz")


# --- a teacher's observations -------------------------------------------------------------------------------------------


def _normalised(**options):
    return VecNormalize(DummyVecEnv([TwoViewBandit]), **options)


def _sac(env, **options):
    options = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 4, "device": "cpu", **options}
    return SAC("MultiInputPolicy", env, **options).learn(8)


@pytest.mark.parametrize(
    ("teacher", "env", "entry"),
    [
        (lambda: _sac(_normalised()), TwoViewBandit, '"partial" that was normalised by VecNormalize, but env gives it raw'),
        (lambda: _sac(TwoViewBandit()), _normalised, '"partial" that was raw, but env gives it normalised by VecNormalize'),
        (lambda: _teacher().learn(20), _normalised, '"partial" that was raw, but env gives it normalised'),
        (lambda: _teacher(_normalised()).learn(20), lambda: _normalised(norm_obs=False), '"partial" that was normalised'),
        (
            lambda: _teacher(_normalised(norm_obs_keys=["privileged"])).learn(20),
            lambda: _normalised(norm_obs_keys=["partial"]),
            '"partial" that was raw',
        ),
    ],
    ids=["sac, then raw", "sac raw", "raw", "rewards alone", "other entries"],
)
def test_a_teacher_on_another_scale_is_refused(teacher, env, entry):
    with pytest.raises(ValueError, match=f"teacher was trained on an entry {entry}"):
        small_model(env(), TGRL, teacher=teacher())


def test_a_teacher_on_the_same_scale_teaches_and_other_environments_are_looked_at():
    env = _normalised()
    model = small_model(env, TGRL, teacher=_sac(env)).learn(20)
    with pytest.raises(ValueError, match='"partial" that was normalised by VecNormalize, but env gives it raw'):
        model.set_env(TwoViewBandit())
    model.learn(20)


@pytest.mark.parametrize("cls", [TGRL, COSIL])
def test_sb3s_own_may_teach_a_policy_with_a_memory(cls):
    memory = {"net_arch": [8], "rnn_hidden_size": 4, "rnn_net_arch": [8]}
    model = small_model(cls=cls, teacher=_sac(TwoViewBandit()), policy="MultiInputGruPolicy", policy_kwargs=memory).learn(30)
    sequences = {"partial": th.randn(5, 3, 2), "privileged": th.rand(5, 3, 1)}
    teacher = model.frozen["teacher"]
    at_once = teacher(sequences)
    for step in range(5):
        alone = teacher({key: entry[step] for key, entry in sequences.items()})
        th.testing.assert_close(at_once.mean[step], alone.mean)
        th.testing.assert_close(at_once.log_std[step], alone.log_std)


def test_a_teacher_that_explores_by_gsde_is_refused():
    with pytest.raises(ValueError, match="teacher explores by gSDE"):
        FrozenPolicy(_sac(TwoViewBandit(), use_sde=True))


def test_a_file_of_an_earlier_version_says_that_it_was_normalised_and_not_which_entries():
    teacher = _teacher(_normalised()).learn(20)
    teacher.normalised_entries = None
    with pytest.raises(ValueError, match='"partial" that was normalised by VecNormalize, but env gives it raw'):
        small_model(TwoViewBandit(), TGRL, teacher=teacher)
    assert small_model(_normalised(), TGRL, teacher=teacher).frozen
