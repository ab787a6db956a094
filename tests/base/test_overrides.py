"""Arguments given to load() and resume(): each counts, or is refused by name."""

import itertools

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer

from sb3_gac import GAC, AsymmetricSAC, EpisodeReplayBuffer, GACShare
from sb3_gac.base.overrides import algorithm_of
from sb3_gac.optim.coefficients import AdditiveCoefficient
from tests.helpers import Recall, TwoViewBandit, optimizers_of, small_model
from tests.registry import classes

ALGORITHMS = classes("replay")
HOW = ["load", "resume"]


def _again(how, model, path, **given):
    """The model as it comes back from a file, with other arguments."""
    path.mkdir(exist_ok=True)
    if how == "load":
        model.save(path / "model")
        return type(model).load(path / "model", env=TwoViewBandit(), device="cpu", **given)
    model.save_checkpoint(path)
    return type(model).resume(path, TwoViewBandit(), device="cpu", **given)


def _rates(policy):
    return [optimizer.param_groups[0]["lr"] for optimizer in optimizers_of(policy)]


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("cls", ALGORITHMS)
def test_scales_of_learning_rates_count_and_momentum_goes_on(how, cls, tmp_path):
    model = small_model(cls=cls, lr_scales={"critic": 5.0}).learn(20)
    deployed = model.policy.roles.deployed
    again = _again(how, model, tmp_path, lr_scales={deployed: 3.0})
    before, after = (m.policy.critic.optimizer.state_dict()["state"][0]["exp_avg"] for m in (model, again))
    assert th.equal(before, after)
    again.learn(1, reset_num_timesteps=False)
    assert _rates(again.policy) == pytest.approx([9e-4] + [3e-4] * (len(_rates(again.policy)) - 1))


COEFFICIENTS = [(GACShare, "ent_coef"), (GAC, "kl_coef"), (AsymmetricSAC, "ent_coef")]


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize(("cls", "name"), COEFFICIENTS)
class TestCoefficients:
    def test_a_number_in_place_of_a_learned_one(self, how, cls, name, tmp_path):
        model = small_model(cls=cls).learn(20)
        again = _again(how, model, tmp_path, **{name: 0.05})
        assert getattr(again, f"{name}_dual").value.item() == pytest.approx(0.05)
        again.learn(10, reset_num_timesteps=False)
        assert getattr(again, f"{name}_dual").value.item() == pytest.approx(0.05)
        twice = _again(how, again, tmp_path / "again")
        assert getattr(twice, f"{name}_dual").value.item() == pytest.approx(0.05)

    def test_a_learned_one_in_place_of_a_number(self, how, cls, name, tmp_path):
        model = small_model(cls=cls, **{name: 0.3}).learn(20)
        again = _again(how, model, tmp_path, **{name: "auto_0.5"})
        dual = getattr(again, f"{name}_dual")
        assert dual.value.item() == pytest.approx(0.5)
        again.learn(10, reset_num_timesteps=False)
        assert dual.value.item() != pytest.approx(0.5, abs=1e-6)

    def test_another_number(self, how, cls, name, tmp_path):
        again = _again(how, small_model(cls=cls, **{name: 0.3}).learn(15), tmp_path, **{name: 0.7})
        assert getattr(again, f"{name}_dual").value.item() == pytest.approx(0.7)

    @pytest.mark.parametrize("given", ["auto", "auto_0.2"])
    def test_what_is_learned_before_and_after_goes_on(self, how, cls, name, given, tmp_path):
        model = small_model(cls=cls, **{name: "auto_0.2"}).learn(20)
        again = _again(how, model, tmp_path, **{name: given})
        before, after = (getattr(m, f"{name}_dual") for m in (model, again))
        assert th.equal(before.value, after.value)
        assert before.value.item() != pytest.approx(0.2, abs=1e-6)
        states = [dual.optimizer.state_dict()["state"] for dual in (before, after)]
        th.testing.assert_close(*states)

    def test_a_new_start_value_counts(self, how, cls, name, tmp_path):
        again = _again(how, small_model(cls=cls).learn(20), tmp_path, **{name: "auto_0.9"})
        assert getattr(again, f"{name}_dual").value.item() == pytest.approx(0.9)

    def test_nonsense_is_refused_by_name(self, how, cls, name, tmp_path):
        with pytest.raises(ValueError, match=f'{name} must be "auto"'):
            _again(how, small_model(cls=cls).learn(15), tmp_path, **{name: "automatic"})


@pytest.mark.parametrize("how", HOW)
def test_rate_and_bounds_of_the_kl_coefficient_count(how, tmp_path):
    model = small_model().learn(20)
    again = _again(how, model, tmp_path, kl_coef_learning_rate=0.1, kl_coef_bounds=(5.0, 10.0))
    assert again.kl_coef_dual.optimizer.param_groups[0]["lr"] == 0.1
    assert again.kl_coef_dual.value.item() == pytest.approx(5.0)
    assert th.equal(again.ent_coef_tensor, model.ent_coef_tensor)
    again.learn(5, reset_num_timesteps=False)
    assert again.kl_coef_dual.value.item() >= 5.0 * (1 - 1e-6)
    with pytest.raises(ValueError, match=r"start value of kl_coef.*outside kl_coef_bounds"):
        _again(how, small_model(kl_coef="auto_1").learn(15), tmp_path / "other", kl_coef_bounds=(5.0, 10.0))


#: Argument -> (value given, what the model then says)
COUNTS = {
    "learning_rate": (1e-5, lambda m: m.policy.deployed.optimizer.param_groups[0]["lr"]),
    "learning_starts": (17, lambda m: m.learning_starts),
    "batch_size": (4, lambda m: m.batch_size),
    "tau": (0.5, lambda m: m.tau),
    "gamma": (0.5, lambda m: m.replay_buffer.gamma),
    "n_steps": (3, lambda m: m.replay_buffer.n_steps),
    "train_freq": ((1, "episode"), lambda m: (m.train_freq.frequency, m.train_freq.unit.value)),
    "gradient_steps": (3, lambda m: m.gradient_steps),
    "target_update_interval": (3, lambda m: m.target_update_interval),
    "target_entropy": (-2.0, lambda m: m.target_entropy),
    "max_grad_norm": (None, lambda m: m.max_grad_norm),
    "stats_window_size": (3, lambda m: m.ep_info_buffer.maxlen),
    "strict_deployment": (True, lambda m: m.strict_deployment),
    "seed": (5, lambda m: m.seed),
}
GACS_OWN = {
    "target_kl": (0.02, lambda m: m.current_target_kl),
    "max_kl": (0.3, lambda m: m.policy.guider.max_kl),
    "kl_reduction": ("sum", lambda m: m.policy.guider.kl_reduction),
    "learner_kl_scale": (0.5, lambda m: m.learner_kl_weight),
}


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_what_is_given_counts(how, cls, tmp_path):
    expected = COUNTS if cls is AsymmetricSAC else COUNTS | GACS_OWN
    given = {name: value for name, (value, _) in expected.items()}
    again = _again(how, small_model(cls=cls).learn(20), tmp_path, **given).learn(3, reset_num_timesteps=False)
    assert {name: read(again) for name, (_, read) in expected.items()} == given


@pytest.mark.parametrize("how", HOW)
def test_the_last_episodes_stay_as_far_as_there_is_room(how, tmp_path):
    model = small_model().learn(20)
    again = _again(how, model, tmp_path, stats_window_size=3)
    assert list(again.ep_info_buffer) == list(model.ep_info_buffer)[-3:]
    assert len(again.ep_info_buffer) == 3
    assert list(_again(how, model, tmp_path, tau=0.1).ep_info_buffer) == list(model.ep_info_buffer)


@pytest.mark.parametrize("how", HOW)
def test_policy_kwargs_that_are_new_are_refused_by_name(how, tmp_path):
    with pytest.raises(ValueError, match=r"policy_kwargs can't be changed.*: n_critics is 3, and was None\."):
        _again(how, small_model().learn(1), tmp_path, policy_kwargs={"net_arch": [16], "n_critics": 3})


def test_another_seed_counts_and_the_same_one_changes_nothing(tmp_path):
    model = small_model(learning_starts=100).learn(20)
    draws = []
    for seed in ({}, {"seed": 0}, {"seed": 7}):
        again = _again("resume", model, tmp_path, **seed)
        again.learn(5, reset_num_timesteps=False)
        draws.append(again.replay_buffer.actions[20:25].copy())
    assert np.array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])


def test_a_buffer_from_a_file_is_sampled_as_the_model_says(tmp_path):
    model = small_model().learn(20)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = GAC.load(tmp_path / "model", n_steps=3, gamma=0.5)
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert (loaded.replay_buffer.n_steps, loaded.replay_buffer.gamma) == (3, 0.5)
    assert loaded.replay_buffer.sample(64).discounts.max() <= 0.5
    recurrent = small_model(Recall(), policy="MultiInputGruPolicy", policy_kwargs={"net_arch": [8], "rnn_hidden_size": 8})
    recurrent.learn(20).save_replay_buffer(tmp_path / "episodes")
    recurrent.save(tmp_path / "recurrent")
    loaded = GAC.load(tmp_path / "recurrent", replay_buffer_kwargs={"sequence_length": 2})
    loaded.load_replay_buffer(tmp_path / "episodes")
    assert loaded.replay_buffer.sequence_length == 2


#: Argument -> another value than the model's
FIXED = {
    "policy": "MultiInputGruPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "role_keys": {"critic": ["privileged"]},
}
FIXED_IN_CHECKPOINTS = {
    "buffer_size": 50,
    "replay_buffer_kwargs": {"storage_dtype": "float16"},
    "replay_buffer_class": EpisodeReplayBuffer,
}


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
@pytest.mark.parametrize(
    ("how", "name"), [*itertools.product(HOW, FIXED), *itertools.product(["resume"], FIXED_IN_CHECKPOINTS)]
)
def test_what_networks_and_rows_were_made_with_is_refused_by_name(how, name, cls, tmp_path):
    with pytest.raises(ValueError, match=name):
        _again(how, small_model(cls=cls).learn(15), tmp_path, **{name: {**FIXED, **FIXED_IN_CHECKPOINTS}[name]})


@pytest.mark.parametrize("how", HOW)
def test_the_same_may_be_given_again(how, tmp_path):
    same = {"policy": "MultiInputPolicy", "policy_kwargs": {"net_arch": [np.int64(16)]}, "buffer_size": 1000}
    assert _again(how, small_model().learn(15), tmp_path, **same).learn(15)._n_updates > 0


#: What is no argument -> what the message says
UNKNOWN = {
    "learning_rat": 'Is "learning_rate" meant',
    "net_arch": "one of policy_kwargs",
    "n_critics": "one of policy_kwargs",
    "n_envs": "follows from env",
    "use_sde": "no state-dependent exploration .* Leave it out",
    "colour": "It takes policy, .*learning_rate",
}


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("cls", ALGORITHMS)
def test_what_is_no_argument_is_refused_by_name(how, cls, tmp_path):
    model = small_model(cls=cls).learn(5)
    for name, hint in UNKNOWN.items():
        with pytest.raises(TypeError, match=f'"{name}", which is no argument of {cls.__name__}. .*{hint}'):
            _again(how, model, tmp_path, **{name: 3})


def test_custom_objects_count_as_well(tmp_path):
    small_model().learn(15).save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", custom_objects={"ent_coef": 0.05, "gamma": 0.5, "unheard of": 3})
    assert loaded.ent_coef_tensor.item() == pytest.approx(0.05)
    assert loaded.gamma == 0.5


# --- whose file it is -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("saved", ALGORITHMS)
def test_another_algorithms_file_says_whose_it_is(saved, tmp_path):
    small_model(cls=saved).save(tmp_path / "model")
    for cls in ALGORITHMS:
        if cls is saved:
            assert cls.load(tmp_path / "model").algorithm == cls.__name__
            continue
        with pytest.raises(ValueError, match=rf"model of {saved.__name__}, not of {cls.__name__}.*{saved.__name__}\.load"):
            cls.load(tmp_path / "model")


class Mine(GACShare):
    """A subclass of a user's."""


def test_a_subclass_elsewhere_is_the_same_algorithm(tmp_path):
    assert [algorithm_of(cls) for cls in (*ALGORITHMS, Mine)] == [*(cls.__name__ for cls in ALGORITHMS), "GACShare"]
    small_model(cls=Mine).save(tmp_path / "model")
    assert type(GACShare.load(tmp_path / "model")) is GACShare
    assert type(Mine.load(tmp_path / "model")) is Mine


def test_another_librarys_file_and_an_older_one(tmp_path):
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "sac")
    with pytest.raises(ValueError, match="does not hold a model of GAC: its policy is SACPolicy"):
        GAC.load(tmp_path / "sac")
    small_model().save(tmp_path / "older", exclude=["algorithm"])
    assert GAC.load(tmp_path / "older").algorithm == "GAC"
    with pytest.raises(ValueError, match="does not hold a model of AsymmetricSAC: its policy is GACPolicy"):
        AsymmetricSAC.load(tmp_path / "older")


def test_other_buffers_are_left_alone(tmp_path):
    model = small_model(replay_buffer_class=DictReplayBuffer).learn(15)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = GAC.load(tmp_path / "model", env=TwoViewBandit())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.learn(15)._n_updates > 0


class _HandsOn(GAC):
    """As users write them: it names no argument but its own."""

    def __init__(self, *args, weight=1.0, **kwargs):
        self.weight = weight
        super().__init__(*args, **kwargs)


def test_a_subclass_that_hands_its_arguments_on(tmp_path):
    """Those of its ancestors are its own: to override, to write down, to resume with."""
    model = small_model(cls=_HandsOn, gamma=0.8, weight=2.0).learn(12)
    model.save(tmp_path / "model")
    loaded = _HandsOn.load(tmp_path / "model", env=TwoViewBandit(), target_kl=0.02)
    assert (loaded.gamma, loaded.weight, loaded.current_target_kl) == (0.8, 2.0, 0.02)
    model.save_checkpoint(tmp_path / "checkpoints")
    resumed = _HandsOn.resume(tmp_path / "checkpoints", TwoViewBandit(), device="cpu", tau=0.1)
    assert (resumed.gamma, resumed.weight, resumed.tau) == (0.8, 2.0, 0.1)
    with pytest.raises(TypeError, match=r'"gama", which is no argument of _HandsOn. Is "gamma" meant'):
        _HandsOn.load(tmp_path / "model", gama=0.5)


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_a_policy_that_is_saved_by_itself_has_the_scales_that_were_given(cls, tmp_path):
    again = _again("load", small_model(cls=cls), tmp_path, lr_scales={"critic": 3.0})
    again.policy.save(tmp_path / "policy")
    loaded = type(again.policy).load(tmp_path / "policy")
    scales = [[optimizer.param_groups[0]["lr_scale"] for optimizer in optimizers_of(p)] for p in (again.policy, loaded)]
    assert scales[0] == scales[1]
    assert set(scales[1]) == {1.0, 3.0}


class _Weighted(AsymmetricSAC):
    """Has a coefficient that no argument is the start value of."""

    def make_coefficients(self):
        weight = AdditiveCoefficient(1.0, 0.5, (0.0, 9.0), self.device)
        return super().make_coefficients() | {"weight": weight}


@pytest.mark.parametrize("how", ["load", "resume"])
def test_a_coefficient_without_an_argument_stays_when_another_is_given(how, tmp_path):
    model = small_model(cls=_Weighted).learn(20)
    model.coefficients["weight"].move(1.0)
    again = _again(how, model, tmp_path, ent_coef=0.25)
    assert again.coefficients["weight"].value == 1.5
    assert again.coefficients["ent_coef"].value == 0.25
