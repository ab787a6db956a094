"""Schedules that are text: what they say, and what they refuse."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_gac.base.behaviour import Behaviour
from sb3_gac.base.roles import Roles
from sb3_gac.schedules import NamedSchedule, as_schedule, read_schedule
from tests.helpers import small_model

POSITIVE = st.floats(1e-6, 1e3)


@pytest.mark.parametrize(
    ("text", "schedule"),
    [
        ("linear 1 -> 0", NamedSchedule("linear", 1.0, 0.0)),
        ("linear -0.5->1.5e-1 over .25", NamedSchedule("linear", -0.5, 0.15, 0.25)),
        (" geometric 0.05 -> 0.0033 over 0.6 ", NamedSchedule("geometric", 0.05, 0.0033, 0.6)),
    ],
)
def test_the_text_of_a_schedule(text, schedule):
    assert read_schedule(text) == as_schedule(text) == schedule


def test_numbers_by_hand():
    linear, geometric = read_schedule("linear 3 -> 1 over 0.5"), read_schedule("geometric 8 -> 2 over 0.5")
    assert [linear(remaining) for remaining in (1.0, 0.75, 0.5, 0.25, 0.0)] == pytest.approx([3, 2, 1, 1, 1])
    assert [geometric(remaining) for remaining in (1.0, 0.75, 0.5, 0.0)] == pytest.approx([8, 4, 2, 2])


@given(
    start=POSITIVE,
    end=POSITIVE,
    over=st.floats(0.01, 1.0),
    remaining=st.floats(0.0, 1.0),
    kind=st.sampled_from(["linear", "geometric"]),
)
def test_a_schedule_stays_between_its_ends_and_keeps_the_last(start, end, over, remaining, kind):
    schedule = NamedSchedule(kind, start, end, over)
    assert schedule(1.0) == pytest.approx(start)
    assert schedule(0.0) == end
    low, high = sorted((start, end))
    assert low * (1 - 1e-9) <= schedule(remaining) <= high * (1 + 1e-9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("geometic 0.05 -> 0.01", 'write "linear START -> END"'),
        ("linear 0.05", 'write "linear START -> END"'),
        ("geometric 0 -> 1", "above 0"),
        ("linear 1 -> 0 over 0", "at most 1"),
        ("linear 1 -> 0 over 1.5", "at most 1"),
    ],
)
def test_what_is_no_schedule_is_refused_and_the_argument_named(text, said):
    with pytest.raises(ValueError, match=said):
        read_schedule(text)
    for argument in ("target_kl", "learning_rate", "guidance"):
        with pytest.raises(ValueError, match=f"{argument} must be a number >.*{said}"):
            small_model(**{argument: text})
    with pytest.raises(ValueError, match=f"behaviour, learner: .*{said}"):
        Behaviour(Roles("learner", ("guider",), ("critic",)), {"learner": text})


def test_arguments_that_take_schedules_take_their_text():
    model = small_model(
        target_kl="geometric 0.08 -> 0.02 over 0.5",
        learning_rate="linear 1e-3 -> 0",
        behaviour={"learner": "linear 0 -> 0.5"},
        behaviour_per="environment",
    )
    model._current_progress_remaining = 0.75
    assert model.current_target_kl == pytest.approx(0.04)
    assert model.lr_schedule(0.5) == pytest.approx(5e-4)
    assert model.chooses_behaviour.shares_at(0.5) == {"learner": 0.25}


def test_a_negative_end_is_refused():
    with pytest.raises(ValueError, match="target_kl at the end of training must be"):
        small_model(target_kl="linear 0.1 -> -0.1")
