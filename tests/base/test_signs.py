"""Live signs: when training says that the guider adds nothing, or too much."""

import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import Logger

from sb3_gac import GAC
from sb3_gac.base.signs import BLOCK, BLOCKS_IN_A_ROW, LOOKS_IN_A_ROW, SMALL_EFFECT, SMALL_GAIN, effect_bounds, gain_and_error
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model


def _model(**arguments):
    model = small_model(**arguments)
    model.set_logger(Logger(None, []))
    return model


def _episodes(model, guider, learner):
    """Blocks of the returns of both: arrays of shape (blocks, BLOCK)."""
    for block in zip(guider, learner, strict=True):
        for returns in zip(*block, strict=True):
            for role, value in zip(("guider", "learner"), returns, strict=True):
                model.on_episode_end(0, float(value), role)


# --- the numbers ------------------------------------------------------------------------------------------------------


def test_effect_by_hand():
    """Means 2 and 1, variances 2 each: a difference of 1 / sqrt(2), its error sqrt(2 / 2 + 2 / 2)."""
    low, high = effect_bounds([1.0, 3.0], [0.0, 2.0])
    assert (low + high) / 2 == pytest.approx(0.7071068)
    assert (high - low) / 2 == pytest.approx(1.96)
    assert effect_bounds([1.0, 1.0], [1.0, 1.0]) == (0.0, 0.0)
    assert effect_bounds([2.0, 2.0], [1.0, 1.0]) == (float("inf"), float("inf"))


def test_unequal_numbers_and_variances_by_hand():
    """Variances 1 of 3 and 16 of 2, so errors sqrt(1/3 + 16/2), in units of sqrt(17/2)."""
    low, high = effect_bounds([1.0, 2.0, 3.0], [0.0, 32**0.5])
    assert (high - low) / 2 == pytest.approx(1.96 * (1 / 3 + 8) ** 0.5 / 8.5**0.5)


def test_gain_by_hand():
    """Critics with means 1.5 and 0.5 over states whose own means are 2 and 0, over 10 steps, in units of 4."""
    gain, error = gain_and_error(th.tensor([[2.0, 1.0], [2.0, -1.0]]), 10.0, 4.0)
    assert gain == pytest.approx(1.0 * 2.5)
    assert error == pytest.approx((1.0 / 2 + 0.25) ** 0.5 * 2.5)
    assert gain_and_error(th.tensor([[2.0, 0.0]]), 1.0, 1.0)[1] == pytest.approx(0.5**0.5), "one critic can't disagree"


def test_a_residual_guider_that_is_its_learner_gains_nothing():
    for env in (TwoViewBandit(length=4), TwoViewChoice(length=4)):
        model = _model(env=env).learn(40)
        with th.no_grad():
            for parameter in model.policy.guider.parameters():
                parameter.zero_()
        assert model.guider_gain() == pytest.approx((0.0, 0.0), abs=1e-5)


def test_padding_has_no_say():
    model = _model(env=Recall(), policy_kwargs={"net_arch": [8], "rnn_type": {"learner": "gru"}}, batch_size=4).learn(60)
    batch = model._sample_batch(4)
    outputs = batch.outputs(model.policy.learner).now
    mask = th.zeros_like(batch.mask)
    mask[0, 1] = 1
    assert model._values(batch._replace(mask=mask), outputs).shape == (1, 1)


# --- what is warned of, and what not ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gap", "blocks", "expected"),
    [
        (0.0, BLOCKS_IN_A_ROW, "a difference of .* standard deviations: guidance adds nothing. Raise target_kl"),
        (-3.0, BLOCKS_IN_A_ROW, "guidance adds nothing"),
        (3.0, BLOCKS_IN_A_ROW, "imitation gap.*behaviour"),
        (0.0, BLOCKS_IN_A_ROW - 1, None),
        (3.0, BLOCKS_IN_A_ROW - 1, None),
    ],
)
def test_blocks_of_episodes(gap, blocks, expected):
    model = _model()
    returns = np.tile(np.linspace(-1, 1, BLOCK), (blocks, 1))
    if expected is None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            _episodes(model, returns + gap, returns)
        return
    with pytest.warns(UserWarning, match=expected) as caught:
        _episodes(model, np.tile(returns, (4, 1)) + gap, np.tile(returns, (4, 1)))
    assert len(caught) == 1, "once"
    assert model.logger.name_to_value["guidance/effect_low"] < model.logger.name_to_value["guidance/effect_high"]


def test_a_block_between_that_shows_nothing_starts_anew():
    model = _model()
    same = np.tile(np.linspace(-1, 1, BLOCK), (BLOCKS_IN_A_ROW - 1, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _episodes(model, same + 3.0, same)
        _episodes(model, same[:1], same[:1])
        _episodes(model, same + 3.0, same)


@pytest.mark.parametrize("effect", [0.0, SMALL_EFFECT])
def test_noise_alone_rarely_warns(effect):
    """
    Of 100 trainings of 20 blocks with equal policies below 5% are told of a gap, and of those whose guider is as much better
    as counts below 5% that it adds nothing; while nearly all of the former are told that.
    """
    rng = np.random.default_rng(0)
    told = []
    model = _model()
    for _ in range(100):
        model.start_comparing("guider", "learner", 1000, 20)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _episodes(model, effect + rng.standard_normal((20, BLOCK)), rng.standard_normal((20, BLOCK)))
        told.append(set(model.signs_told))
    wrong, right = (
        ("too much by returns", "nothing by returns") if effect == 0 else ("nothing by returns", "too much by returns")
    )
    assert np.mean([wrong in causes for causes in told]) < 0.05
    assert np.mean([right in causes for causes in told]) > 0.8


@pytest.mark.parametrize(
    ("gain", "error", "warns"),
    [(0.0, 0.0, True), (-0.5, 0.1, True), (SMALL_GAIN / 2, SMALL_GAIN, False), (0.1, 0.0, False), (0.0, 0.1, False)],
)
def test_a_gain_is_absent_only_where_little_of_it_may_be_left(gain, error, warns):
    model = _model()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3 * LOOKS_IN_A_ROW):
            model._judge_gain(gain, error)
    assert ["gain" in str(w.message) and "target_kl" in str(w.message) for w in caught] == [True] * warns
    assert model.logger.name_to_value["guidance/gain"] == gain


@pytest.mark.parametrize(
    ("kl", "on_bound", "expected"),
    [
        (0.001, 1.0, "nothing by kl"),
        (0.001, 0.0, "held back by kl"),
        (0.021, 0.0, "too much by kl"),
        (0.005, 1.0, None),
        (0.0199, 1.0, None),
    ],
)
def test_kl_far_from_its_target(kl, on_bound, expected):
    model, blind = _model(), _model()
    seen = {"kl": kl - 1e-9, "target_kl": 0.01, "kl_coef": 0.5, "kl_coef_on_bound": on_bound}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3 * LOOKS_IN_A_ROW):
            model._judge_kl(seen | {"kl_coef_loss": 0.0})
            blind._judge_kl(seen)
    assert not blind.signs_told, "a fixed coefficient holds KL to no target"
    assert model.signs_told == ([] if expected is None else [expected])
    assert len(caught) == len(model.signs_told)


# --- in training ----------------------------------------------------------------------------------------------------------


def _looking_often(**arguments):
    model = small_model(TwoViewBandit(length=4), learning_starts=8, behaviour={"learner": 0.5}, **arguments)
    model.start_comparing("guider", "learner", 10, 20)
    return model


def test_looking_changes_nothing_to_the_bit(monkeypatch):
    watched = _looking_often().learn(150)
    assert watched.signs_in_a_row, "it looked"
    monkeypatch.setattr(GAC, "guider_gain", lambda self: (1.0, 0.0))
    blind = _looking_often().learn(150)
    for name, value in watched.policy.state_dict().items():
        assert th.equal(value, blind.policy.state_dict()[name]), name


@pytest.mark.filterwarnings("ignore:After")
def test_signs_go_on_after_a_checkpoint_and_in_a_file(tmp_path):
    through, stopped = _looking_often().learn(207), _looking_often().learn(93)
    stopped.save_checkpoint(tmp_path / "checkpoints")
    resumed = GAC.resume(tmp_path / "checkpoints", TwoViewBandit(length=4), device="cpu")
    resumed.compare_every = through.compare_every
    resumed.learn(114, reset_num_timesteps=False)
    assert resumed.block == through.block
    assert resumed.signs_in_a_row == through.signs_in_a_row
    assert sum(through.signs_in_a_row.values()) > 0
    assert resumed.signs_told == through.signs_told
    through.save(tmp_path / "model")
    assert GAC.load(tmp_path / "model").signs_in_a_row == through.signs_in_a_row


def test_no_kl_is_small_or_large_beside_a_target_of_0():
    """At a schedule's end; a schedule may begin at 0 as well."""
    model = _model()
    for _ in range(3 * LOOKS_IN_A_ROW):
        model._judge_kl({"kl": 0.1, "target_kl": 0.0, "kl_coef": 0.5, "kl_coef_on_bound": 1.0, "kl_coef_loss": 0.0})
    assert not model.signs_told
    model = small_model(TwoViewBandit(length=4), target_kl="linear 0.01 -> 0", learning_starts=950).learn(999)
    model.learn(100, reset_num_timesteps=False)


def test_a_model_that_was_just_loaded_has_no_data_to_look_at(tmp_path):
    memory = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}
    options = {"policy": "MultiInputGruPolicy", "policy_kwargs": memory, "batch_size": 2, "learning_starts": 60}
    small_model(TwoViewBandit(length=50), **options).learn(80).save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", env=TwoViewBandit(length=50), learning_starts=200)
    loaded.compare_every = 10
    looks = []
    loaded._judge_gain = lambda gain, error: looks.append(loaded.num_timesteps)
    loaded.learn(100, reset_num_timesteps=False)
    assert looks == [130, 140, 150, 160, 170, 180], "with a whole episode"
