"""What is shown of a run under way: a bar on a terminal, elsewhere a line for each evaluation."""

import io
import sys
import warnings
from types import SimpleNamespace

import pytest

from sb3_gac import GuiderLearnerEvalCallback, SeededEvalCallback
from sb3_gac.training import progress
from sb3_gac.training.curve import draw_learning_curve
from sb3_gac.training.directory import shown
from sb3_gac.training.progress import Progress, clock, warnings_in_a_line
from tests.helpers import TwoViewBandit, small_model


def _progress(history=(), logged=None, **model):
    callback = Progress(SimpleNamespace(history=list(history)), 50_000)
    callback.model = SimpleNamespace(**{"learning_starts": 2000, **model})
    callback._logged = logged or {}
    return callback


ROW = {"timesteps": 21_000, "learner": 2345.6, "guider": -12.345, "kl": 0.00491, "target_kl": 0.005}


def test_beside_the_bar_there_are_returns_kl_and_time_left(monkeypatch):
    monkeypatch.setattr(progress.time, "monotonic", lambda: 100.0)
    callback = _progress([ROW], {"train/kl": 0.01234, "train/target_kl": 0.005})
    callback.num_timesteps, callback._under_way = 21_000, (40.0, 11_000)  # 60 seconds for 10,000 steps, 29,000 to come
    assert callback.beside_the_bar(80) == "  learner 2346  guider -12.3  KL 0.012/0.005  2:54 left"
    assert len(" 42% ███ 21,000/50,000" + callback.beside_the_bar(80)) <= 80


def test_an_evaluation_is_a_line(monkeypatch):
    callback = _progress([ROW])
    monkeypatch.setattr(progress.time, "monotonic", lambda: callback._started + 65)
    callback.num_timesteps = 21_000
    assert callback.line() == "21,000 of 50,000 steps: learner 2346, guider -12.3, KL 0.0049 (target 0.005); 1:05 so far"
    callback._under_way = (callback._started + 5, 11_000)
    assert callback.line().endswith("; 1:05 so far, 2:54 left")
    callback._evaluation.history[-1] = {"timesteps": 21_000, "learner": 0.5}
    assert "steps: learner 0.5; 1:05" in callback.line(), "of an algorithm without a guider"


def test_before_there_is_anything_to_tell_it_is_warm_up():
    callback = _progress()
    callback.num_timesteps = 1000
    assert callback.beside_the_bar(80) == "  warm-up"
    callback.num_timesteps = 2001
    assert callback.beside_the_bar(80) == ""


class Terminal(io.StringIO):
    """Somebody looks at it."""

    def isatty(self):
        return True


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_terminal_has_a_bar_and_a_file_has_lines(is_terminal, monkeypatch, capsys):
    screen = Terminal() if is_terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    model = small_model(learning_starts=20, train_freq=1)
    evaluation = GuiderLearnerEvalCallback(TwoViewBandit(), eval_freq=20, n_eval_episodes=1, verbose=0)
    model.learn(60, callback=[evaluation, Progress(evaluation, 60)])
    lines = capsys.readouterr().out.splitlines()
    if is_terminal:
        first, *_, last = filter(str.strip, screen.getvalue().split("\r"))
        assert "warm-up" in first, "a note would stand behind a bar that is not whole yet"
        assert "100%" in last
        assert "60/60  learner " in last
        assert "  KL " in last
        assert " in all" in last
        assert lines == []
    else:
        assert screen.getvalue() == ""
        assert [line.split(" steps: learner")[0] for line in lines] == ["20 of 60", "40 of 60", "60 of 60"]


def test_compiling_is_said_before_it_begins(capsys, monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    model = small_model(learning_starts=20, train_freq=1, compile=True)
    monkeypatch.setattr("sb3_gac.optim.compile.th.compile", lambda function, **options: function)
    evaluation = SeededEvalCallback(TwoViewBandit(), eval_freq=20, n_eval_episodes=1, verbose=0)
    model.learn(40, callback=[evaluation, Progress(evaluation, 40)])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["20", "Compiling", "40"]


def test_warnings_are_sentences_without_a_line_of_code(capsys):
    with warnings_in_a_line():
        warnings.warn("The learner does not keep up.", stacklevel=1)
        warnings.warn("Stopped by SIGTERM; ...", stacklevel=1)
    assert capsys.readouterr().err.strip() == "Note: The learner does not keep up."


def test_durations_and_returns_are_short():
    assert [clock(seconds) for seconds in (0, 65, 7230)] == ["0:00", "1:05", "2:00:30"]
    assert [shown(value) for value in (9351.4, -123.4, 12.345, 0.51234)] == ["9351", "-123", "12.3", "0.512"]


@pytest.mark.parametrize("with_guider", [True, False])
def test_the_curve_marks_warm_up_and_policies_without_training(with_guider, tmp_path, monkeypatch):
    from matplotlib import pyplot as plt

    kept = []
    monkeypatch.setattr(plt, "close", kept.append)
    rows = [{"timesteps": 1000, "learner": 1.0}, {"timesteps": 3000, "learner": 5.0}]
    if with_guider:
        rows = [row | {"guider": 2.0} for row in rows]
        rows[-1] |= {"kl": 0.1, "target_kl": 0.2}
    draw_learning_curve(
        rows, "GAC", tmp_path / "curve.png", {"random actions": (-3.0, 0.1), "the middle action": (-1.0, 0.2)}, 2000
    )
    (figure,) = kept
    monkeypatch.undo()
    returns, *others = figure.axes
    assert len(others) == with_guider
    labels = {handle.get_label(): handle for handle in returns.get_legend_handles_labels()[0]}
    assert set(labels) == {"learner (partial alone)", "random actions", "the middle action", "warm-up"} | (
        {"guider (privileged)"} if with_guider else set()
    )
    assert [set(labels[name].get_ydata()) for name in ("random actions", "the middle action")] == [{-3.0}, {-1.0}]
    of_kl = {line.get_label(): list(line.get_ydata())[-1] for axis in others for line in axis.get_lines()}
    assert of_kl == ({"KL(guider ‖ learner)": 0.1, "target": 0.2} if with_guider else {})
    assert labels["warm-up"].get_extents().transformed(returns.transData.inverted()).x1 == pytest.approx(2000)
    plt.close(figure)
