"""Named sets of arguments."""

import pytest

from sb3_gac import GAC, preset
from tests.helpers import TwoViewBandit


@pytest.mark.parametrize("name", ["small", "paper"])
def test_presets_train(name):
    arguments = preset(name, learning_starts=20, batch_size=8, gradient_steps=1, buffer_size=100)
    model = GAC("MultiInputPolicy", TwoViewBandit(), **arguments)
    model.learn(30)
    assert model._n_updates > 0


def test_preset_paper_is_the_papers_table():
    model = GAC("MultiInputPolicy", TwoViewBandit(), **preset("paper", buffer_size=1000))
    assert (model.guider, model.batch_size, model.gradient_steps) == ("independent", 512, 64)
    assert (model.gamma, model.tau, model.learning_rate, model.max_grad_norm) == (0.99, 0.005, 3e-4, 1.0)
    assert model.target_entropy == -0.5
    assert model.policy.learner.net_arch == [256, 256]


def test_preset_merges_policy_kwargs_and_leaves_the_table_alone():
    arguments = preset("small", policy_kwargs={"n_critics": 3})
    assert arguments["policy_kwargs"] == {"net_arch": [128, 128], "n_critics": 3}
    assert "n_critics" not in preset("small")["policy_kwargs"]
    with pytest.raises(ValueError, match="preset must be one of"):
        preset("large")


def test_who_changes_what_he_got_does_not_change_the_preset():
    for name in ("small", "paper"):
        arguments = preset(name)
        before = repr(arguments)
        for value in arguments.values():
            if isinstance(value, dict):
                value["more"] = 1
                [layers.append(1) for layers in value.values() if isinstance(layers, list)]
        assert repr(preset(name)) == before
