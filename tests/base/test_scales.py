"""Observations that ``VecNormalize`` normalises: whether they are on the scale that a policy was trained on."""

import warnings

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import COSIL, GAC, TGRL, AsymmetricSAC, demonstrate
from sb3_gac.checks.scale import FAR, inputs_apart, scales_in_training, scales_of
from tests.helpers import Sampled, small_model


class Centred(Sampled):
    """Observations are normally distributed, with a standard deviation of 2."""

    def __init__(self, centre):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        super().__init__(spaces.Dict(partial=box, privileged=box))
        self.centre = np.float32(centre)

    def _moved(self, observation):
        return {key: self.centre + 2 * value for key, value in observation.items()}

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        return self._moved(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self._moved(observation), *rest


def _raw(centre=5.0):
    return DummyVecEnv([lambda: Centred(centre)] * 4)


def _normalised(**kwargs):
    return VecNormalize(_raw(**kwargs), norm_reward=False)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A model, its file, and that of its environments' statistics."""
    folder = tmp_path_factory.mktemp("trained")
    env = _normalised()
    model = small_model(env, AsymmetricSAC).learn(80)
    model.save(folder / "model")
    env.save(str(folder / "statistics.pkl"))
    return model, folder / "model.zip", folder / "statistics.pkl"


def test_how_far_apart_by_hand():
    """Of (3 + 2 z) the second statistics make ((3 + 2 z) - 1) / 4 = 0.5 + 0.5 z, which differs from z by 0.5 - 0.5 z."""
    then, now = ({"a": (np.array([mean]), np.array([std]))} for mean, std in ((3.0, 2.0), (1.0, 4.0)))
    key, apart = inputs_apart(then, now, ["a", "b"])
    assert (key, apart) == ("a", pytest.approx(np.sqrt(0.5)))
    drawn = np.random.RandomState(0).randn(100_000)
    assert apart == pytest.approx(np.sqrt(np.mean(((3 + 2 * drawn - 1) / 4 - drawn) ** 2)), rel=0.01)
    assert inputs_apart(then, then, ["a"]) is None
    assert inputs_apart(then, now, ["b"]) is inputs_apart(then, {}, ["a"]) is inputs_apart({}, now, ["a"]) is None
    near = {"a": (np.array([3.0 + 2 * (FAR - 0.01)]), np.array([2.0]))}
    assert inputs_apart(then, near, ["a"]) is None, "what training moves statistics by is no other scale"


def test_a_models_file_and_its_checkpoint_have_its_scales(trained, tmp_path):
    model, file, _ = trained
    present = scales_of(model.env)
    assert present["partial"][0] == pytest.approx([5.0, 5.0], abs=0.8)
    assert present["partial"][1] == pytest.approx([2.0, 2.0], abs=0.5)
    model.save_checkpoint(tmp_path)
    for other in (model, AsymmetricSAC.load(file, device="cpu"), AsymmetricSAC.resume(tmp_path, _normalised(), device="cpu")):
        scales = scales_in_training(other)
        assert scales.keys() == {"partial", "privileged"}
        for key in scales:
            np.testing.assert_array_equal(scales[key], present[key])
    with_other_env = AsymmetricSAC.load(file, env=_normalised(centre=0.0), device="cpu")
    np.testing.assert_array_equal(scales_in_training(with_other_env)["partial"], present["partial"], "not the new ones")


@pytest.mark.parametrize("cls", [COSIL, TGRL])
@pytest.mark.parametrize("kind", ["model", "file", "sb3"])
def test_a_teacher_under_other_statistics_is_refused_before_it_teaches(cls, kind, trained):
    model, file, statistics = trained
    if kind == "sb3":
        env = _normalised()
        teacher = SAC("MultiInputPolicy", env, policy_kwargs={"net_arch": [8]}, learning_starts=4, device="cpu").learn(80)
    else:
        env, teacher = VecNormalize.load(str(statistics), _raw()), model if kind == "model" else str(file)
    student = small_model(_normalised(centre=0.0), cls, teacher=teacher)
    with pytest.raises(ValueError, match=r'teacher was trained on an entry "p\w+" that VecNormalize normalised by other stat'):
        student.learn(20)
    assert small_model(env, cls, teacher=teacher).learn(20)._n_updates > 0


def test_demonstrations_need_the_teachers_statistics(trained):
    model, _, statistics = trained
    with pytest.raises(ValueError, match='teacher was trained on an entry "partial" that VecNormalize normalised by other'):
        demonstrate(model, _normalised(centre=0.0), 8)
    assert len(demonstrate(model, VecNormalize.load(str(statistics), _raw()), 8)) == 8


def test_training_that_goes_on_under_other_statistics_is_warned_of(trained):
    _, file, statistics = trained
    with pytest.warns(
        UserWarning, match=r'learned from an entry "partial" that VecNormalize .* \d\.\d\d standard deviations off'
    ):
        AsymmetricSAC.load(file, env=_normalised(centre=0.0), device="cpu").learn(4)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The model has learned from an entry")
        AsymmetricSAC.load(file, env=VecNormalize.load(str(statistics), _raw()), device="cpu").learn(4)
        small_model(_normalised(), GAC).learn(40).learn(40)


def test_a_number_that_never_changes_has_no_scale():
    """Of what its statistics began with there is less the longer they are gathered; 2.4e-4 and 1.2e-4 after so many steps."""
    then, now = ({"a": (np.zeros(2), np.array([1.0, std]))} for std in (2.4e-4, 1.2e-4))
    assert inputs_apart(then, now, ["a"]) is None
    moved = {"a": (np.array([0.0, 0.01]), np.array([1.0, 1.2e-4]))}
    assert inputs_apart(then, moved, ["a"]) is not None, "another constant is another input"
    alive = {"a": (np.zeros(2), np.array([1.0, 0.1]))}
    assert inputs_apart(then, alive, ["a"]) is not None, "one that moves is none"
