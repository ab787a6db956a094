"""What somebody who reads an algorithm is promised: short functions, few calls, few ancestors, short files."""

import ast
import inspect
import re
import sys
import textwrap
from difflib import SequenceMatcher
from functools import cache
from pathlib import Path

import pytest
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

import sb3_gac
from sb3_gac import GAC, TGRL, AsymmetricSAC
from sb3_gac.algorithms import algorithm_class
from sb3_gac.baselines.gpo import GPO
from tests import registry
from tests.helpers import TwoViewBandit

PACKAGE = Path(sb3_gac.__file__).parent
BASELINES = sorted(path for path in (PACKAGE / "baselines").glob("[!_]*.py"))
MOST_LINES = {"gpo.py": 300, "rma.py": 220}


def _length(function):
    """Lines of a function's body, without its docstring."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    body = tree.body[1:] if ast.get_docstring(tree) is not None else tree.body
    return body[-1].end_lineno - body[0].lineno + 1


def _own(algorithm):
    """Methods that an algorithm's own file has: its update and its losses."""
    for ancestor in algorithm.__mro__:
        if ancestor.__module__.startswith(("sb3_gac.gac", "sb3_gac.baselines")):
            yield from (
                (name, member)
                for name, member in vars(ancestor).items()
                if inspect.isfunction(member) and (name == "update" or name.endswith("_loss"))
            )


@registry.algorithms()
def test_updates_and_losses_are_short(algorithm):
    found = dict(_own(algorithm_class(algorithm)))
    assert "update" in found
    lengths = {method: _length(function) for method, function in found.items()}
    assert {m: n for m, n in lengths.items() if n > (30 if m == "update" else 15)} == {}


def test_lengths_are_counted_without_the_docstring():
    def two(
        a,
        b,
    ):
        """Of no line.

        None at all.
        """
        c = a
        return b + c

    assert _length(two) == 2


def _depth(cls):
    """How many classes of this package stand above it, by the longest way."""
    above = [base for base in cls.__bases__ if base.__module__.startswith(("sb3_gac", "tests"))]
    return max((1 + _depth(base) for base in above), default=0)


@pytest.mark.parametrize("algorithm", [GAC, AsymmetricSAC, TGRL, GPO])
def test_at_most_three_classes_stand_between_an_algorithm_and_those_of_sb3(algorithm):
    assert _depth(algorithm) <= 3


def test_depth_is_that_of_the_longest_way():
    class A(OffPolicyAlgorithm): ...

    class B(A): ...

    class Both(B, OffPolicyAlgorithm): ...

    assert [_depth(cls) for cls in (A, B, Both)] == [0, 1, 2]


@pytest.mark.parametrize(("name", "loss"), [("gac", "guider_loss"), ("gac", "learner_loss"), ("asymmetric_sac", "actor_loss")])
def test_four_calls_from_train_to_the_equation(name, loss, monkeypatch, set_threads):
    """``ent_coef * log_prob - q`` stands in ``policy_loss``: how many of our functions are on the way to it."""
    set_threads(1)  # with more, branches of an update run on threads of their own, whose calls do not begin at train
    algorithm = algorithm_class(name)
    module, ways = sys.modules[algorithm.__module__], {}
    policy_loss = module.policy_loss

    def noted(*args, **kwargs):
        frame, way = inspect.currentframe().f_back, []
        while frame.f_code.co_name != "train":
            if frame.f_globals["__name__"].startswith("sb3_gac"):
                way.append(frame.f_code.co_name)
            frame = frame.f_back
        ways[way[0]] = [*way[::-1], "policy_loss"]
        return policy_loss(*args, **kwargs)

    monkeypatch.setattr(module, "policy_loss", noted)
    registry.make(name, TwoViewBandit()).learn(60)
    way = [called for called in ways[loss] if called not in ("in_branches", "<lambda>")]  # GAC's two lists of steps
    assert way == ["update", "minimize", loss, "policy_loss"]


@pytest.mark.parametrize("folder", ["sb3_gac", "benchmarks", "examples"])
def test_docstrings_say_what_a_parameter_is(folder):
    """Not what it is of: ``:param gradients: gradient with respect to each parameter``, not ``of each parameter``."""
    says_nothing = re.compile(r":(?:param \**\w+|return): (?:of|to|see|likewise)\b.*")
    found = {
        str(path.relative_to(PACKAGE.parent)): says_nothing.findall(path.read_text())
        for path in (PACKAGE.parent / folder).rglob("*.py")
    }
    assert found
    assert {path: fields for path, fields in found.items() if fields} == {}


@cache
def _code(path):
    """Lines of code, without indentation, blank lines, comments and imports."""
    lines = (line.strip() for line in path.read_text().splitlines())
    return [line for line in lines if line and not line.startswith(("#", "import ", "from "))]


@pytest.mark.parametrize("path", BASELINES, ids=lambda path: path.name)
def test_a_baseline_is_a_short_file_of_its_own(path):
    assert len(path.read_text().splitlines()) < MOST_LINES.get(path.name, 200)
    for other in BASELINES:
        if other != path:
            matches = SequenceMatcher(None, _code(path), _code(other), autojunk=False).get_matching_blocks()
            shared = sum(match.size for match in matches if match.size >= 3)
            assert shared < 0.2 * len(_code(path)), f"{shared} of {len(_code(path))} lines are those of {other.name}"


def _without_encoding(path):
    """Lines on which a file is read or written as text in the locale's encoding, which is not UTF-8 everywhere."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            mode = next((one.value for one in node.args if isinstance(one, ast.Constant)), "r")
            opens_text = (
                name == "open" and "b" not in str(mode) and getattr(getattr(node.func, "value", None), "id", "") != "os"
            )
            if (opens_text or name in ("read_text", "write_text")) and "encoding" not in [one.arg for one in node.keywords]:
                yield f"{path.name}:{node.lineno}"


@pytest.mark.parametrize("folder", ["sb3_gac", "benchmarks"])
def test_text_is_utf_8_whatever_the_locale(folder):
    files = list((PACKAGE.parent / folder).rglob("*.py"))
    assert len(files) > 30
    assert [place for path in files for place in _without_encoding(path)] == []


def test_text_in_the_locales_encoding_is_found(tmp_path):
    code = (
        'p.read_text()\np.write_text("é")\nopen(p)\np.open("rb")\nos.open(p, 1)\np.open("w", encoding="utf-8")\np.open("a")\n'
    )
    (tmp_path / "one.py").write_text(code, encoding="utf-8")
    assert list(_without_encoding(tmp_path / "one.py")) == ["one.py:1", "one.py:2", "one.py:3", "one.py:7"]
