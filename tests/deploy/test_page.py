"""The Python of docs/deployment.md about memories, run as it stands there, but for a shorter training."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import onnxruntime

import sb3_gac

PAGE = (Path(__file__).parents[2] / "docs/deployment.md").read_text()
(PART,) = re.findall(r"\*\*Memory\.\*\*(.*?)\*\*What is refused", PAGE, re.DOTALL)
CPP = re.findall(r"```cpp\n(.*?)```", PAGE, re.DOTALL)


def test_a_recurrent_policy_is_exported_and_acts_as_the_page_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"gymnasium": gymnasium, "np": np, "onnxruntime": onnxruntime}
    names |= {name: getattr(sb3_gac, name) for name in ("GAC", "OnnxPolicy", "export_learner")}
    whole, by_hand = re.findall(r"```python\n(.*?)```", PART, re.DOTALL)
    shorter = whole.replace("20_000", "200").replace("range(3)", "range(2)")
    assert shorter != whole
    exec(compile(shorter, "deployment.md, memory", "exec"), names)
    assert names["ended"]
    exec(compile(by_hand, "deployment.md, by hand", "exec"), names)
    names["learner"].reset()
    np.testing.assert_array_equal(names["action"][0], names["learner"].act(names["obs"]["partial"]))
    assert names["state"].any(), "it remembers"


def test_the_program_in_another_language_names_the_inputs_and_outputs_of_the_file():
    (program,) = CPP
    for name in ("partial", sb3_gac.deploy.export.STATE, sb3_gac.deploy.export.NEXT_STATE, sb3_gac.deploy.export.ACTION):
        assert f'"{name}"' in program
