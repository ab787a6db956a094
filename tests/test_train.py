"""The main job, end to end on a tiny budget."""

import json

import numpy as np
import pytest
import yaml

from sb3_gac import GAC
from sb3_gac.train import PartialOnly, gac_arguments, parse_arguments, summary, train


def test_main_job_leaves_a_model_a_picture_results_and_its_configuration(tmp_path):
    options = ["--task", "InvertedDoublePendulum", "--noise", "0.1", "--steps", "2400", "--seed", "3", "--episodes", "2"]
    directory = train(parse_arguments([*options, "--runs", str(tmp_path)]))
    assert directory.parent == tmp_path
    assert (directory / "learning_curve.png").read_bytes()[:4] == b"\x89PNG"
    configuration = yaml.safe_load((directory / "config.yaml").read_text())
    assert (configuration["task"], configuration["noise"], configuration["seed"]) == ("InvertedDoublePendulum", 0.1, 3)
    assert configuration["gac"]["batch_size"] == 128
    results = json.loads((directory / "results.json").read_text())
    assert np.isfinite([results["learner"], results["random"]]).all()
    assert len(results["history"]) == 10
    last_lines = summary(directory)
    assert f"(noise 0.1) for {results['steps']} steps" in last_lines
    assert results["steps"] == 2400
    assert f"return {results['learner']:.0f} +- {results['learner_std']:.0f} over 2 episodes" in last_lines
    assert f"same seeds: {results['random']:.0f} +- {results['random_std']:.0f}." in last_lines
    assert f'GAC.load("{directory / "model"}")' in last_lines
    action, _ = GAC.load(directory / "model").predict({"partial": np.zeros(5, np.float32)}, deterministic=True)
    assert action.shape == (1,)


def test_the_learner_is_evaluated_on_partial_alone():
    seen = []

    class Model:
        def predict(self, observation, *args, **kwargs):
            seen.append(observation)

    PartialOnly(Model()).predict({"partial": 1, "privileged": 2}, deterministic=True)
    assert seen == [{"partial": 1}]


@pytest.mark.parametrize("arguments", [["--task", "Cheetah"], ["--privileged", "all"], ["--preset", "large"]])
def test_unknown_choices_are_refused(arguments, capsys):
    with pytest.raises(SystemExit):
        parse_arguments(arguments)
    assert "invalid choice" in capsys.readouterr().err


def test_a_preset_brings_its_number_of_environments():
    options = parse_arguments(["--preset", "paper"])
    assert gac_arguments(options)["gradient_steps"] / options.envs == 0.5, "gradient steps per environment step"
    assert parse_arguments([]).envs == 4
    assert parse_arguments(["--preset", "paper", "--envs", "2"]).envs == 2


def test_much_noise_has_the_target_kl_of_the_figures():
    assert gac_arguments(parse_arguments(["--noise", "0.3"]))["target_kl"] == 0.001
    assert "target_kl" not in gac_arguments(parse_arguments(["--noise", "0.1"])), "the default"
