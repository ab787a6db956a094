"""What an extra has and is not installed is told in one sentence, wherever it is missed."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GONE = "import sys; sys.modules.update(dict.fromkeys({}))\n"
#: As an installation that is broken half-way: asking for the module raises, whoever asks
BROKEN = """
import sys
class Broken:
    def find_spec(self, name, *args):
        if name.split(".")[0] in {}:
            raise ModuleNotFoundError(f"No module named {{name!r}}")
sys.meta_path.insert(0, Broken())
"""
EXPORT = """
import tempfile, gymnasium, sb3_gac
model = sb3_gac.GAC("MultiInputPolicy", gymnasium.make("sb3_gac/Pendulum-v1"), buffer_size=10)
sb3_gac.export_learner(model, tempfile.mkdtemp() + "/x.onnx")
"""


@pytest.mark.parametrize(
    ("extra", "module", "block", "use"),
    [
        ("zoo", "rl_zoo3", GONE, "import sb3_gac.zoo"),
        ("export", "onnx", GONE, EXPORT),
        ("export", "onnx", BROKEN, EXPORT),
        ("benchmarks", "pandas", GONE, "import benchmarks.launch"),
        ("ray", "ray", GONE, "from benchmarks.engines import RayEngine; RayEngine('auto')"),
    ],
)
def test_the_extra_is_named_with_how_to_install_it(extra, module, block, use):
    program = block.format([module]) + use
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: ")
    assert f"needs {module}" in last
    assert last.endswith(f'which the extra sb3_gac[{extra}] has: pip install -e ".[{extra}]" in the clone of sb3_gac.')


def test_an_error_of_another_kind_is_left_as_it_is():
    use = BROKEN.format(["stable_baselines3"]) + "import sb3_gac; sb3_gac.GAC"
    result = subprocess.run([sys.executable, "-c", use], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.stderr.strip().splitlines()[-1].startswith("ModuleNotFoundError: No module named 'stable_baselines3")
