"""target_kl="auto": a bound that follows from the episodes of guider and learner."""

import pytest
from stable_baselines3.common.logger import Logger

from sb3_gac import GAC
from sb3_gac.gac.gac import AUTO_TARGET_KL, AUTO_TARGET_KL_BOUNDS
from tests.helpers import TwoViewBandit, small_model

SHARED = {"target_kl": "auto", "behaviour": {"learner": 0.5}}


def _compared(guider, learner, times=1, **arguments):
    model = small_model(**SHARED | arguments)
    model.set_logger(Logger(None, []))
    model.returns.update(guider=guider, learner=learner)
    for model.num_timesteps in range(1000, 1000 * times + 1, 1000):
        model.on_step()
    return model


@pytest.mark.parametrize(
    ("guider", "learner", "factor"),
    [([3.0, 1.0], [1.5], 1.1), ([1.0], [1.0, 2.0], 1 / 1.1), ([1.0], [1.0], 1.0), ([], [1.0], 1.0), ([1.0], [], 1.0)],
)
def test_the_guider_may_go_further_while_its_episodes_return_more(guider, learner, factor):
    model = _compared(guider, learner)
    assert model.current_target_kl == pytest.approx(AUTO_TARGET_KL * factor)
    model.refresh_schedules()
    assert model.target_kl_tensor.item() == pytest.approx(AUTO_TARGET_KL * factor)
    if guider and learner:
        difference = sum(guider) / len(guider) - sum(learner) / len(learner)
        assert model.logger.name_to_value["rollout/guider_minus_learner"] == pytest.approx(difference)


@pytest.mark.parametrize(("guider", "bound"), [(1.0, 1), (-1.0, 0)])
def test_it_stays_within_its_bounds(guider, bound):
    assert _compared([guider], [0.0], times=60).current_target_kl == AUTO_TARGET_KL_BOUNDS[bound]


@pytest.mark.parametrize("target_kl", [0.02, "linear 0.1 -> 0.01"])
def test_a_bound_that_was_given_stays_what_it_is(target_kl):
    model = _compared([9.0], [0.0], target_kl=target_kl)
    assert model.current_target_kl == (0.02 if target_kl == 0.02 else 0.1)


def test_policies_may_act_one_after_the_other():
    small_model(target_kl="auto", behaviour={"learner": lambda left: float(left < 0.5)})


@pytest.mark.parametrize("behaviour", [None, "learner", {"learner": 0.0}, {"learner": 1.0}])
def test_episodes_of_both_policies_are_needed(behaviour):
    with pytest.raises(ValueError, match=r'target_kl="auto" compares episodes.*behaviour=.*"learner": 0.25'):
        small_model(target_kl="auto", behaviour=behaviour)


def test_it_is_resumed_to_the_bit_and_saved(tmp_path):
    through, stopped = _compared_often().learn(107), _compared_often().learn(63)
    stopped.save_checkpoint(tmp_path / "checkpoints")
    resumed = GAC.resume(tmp_path / "checkpoints", TwoViewBandit(length=4), device="cpu")
    resumed.compare_every = through.compare_every
    resumed.learn(44, reset_num_timesteps=False)
    assert resumed.returns == through.returns
    assert resumed.auto_target_kl == through.auto_target_kl != AUTO_TARGET_KL
    through.save(tmp_path / "model")
    assert GAC.load(tmp_path / "model").current_target_kl == through.current_target_kl


def _compared_often():
    model = small_model(TwoViewBandit(length=4), learning_starts=8, **SHARED)
    model.start_comparing("guider", "learner", 10, 20)
    return model
