"""The list of mutants is up to date, and the program that puts them in tells the killed from the survivors."""

import multiprocessing

import pytest

from tests import mutate
from tests.mutate import ROOT, Mutant, MutantError, listed_mutants, main

MUTANTS = listed_mutants()


@pytest.fixture(autouse=True)
def _nothing_to_import_first(monkeypatch):
    """The tests below have small projects, for which no torch needs to be imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([])
    monkeypatch.setattr(mutate, "_CONTEXT", context)


def test_every_mutant_can_be_put_in_and_its_tests_are_there():
    stale = []
    for mutant in MUTANTS:
        try:
            mutant.check(ROOT)
        except MutantError as error:
            stale.append(str(error))
    assert not stale, "\n".join(stale)


def test_no_mutant_is_listed_twice():
    changes = [(mutant.file, mutant.old, mutant.new) for mutant in MUTANTS]
    assert len(set(changes)) == len(changes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"old": "gone"}, "'gone' occurs 0 times"),
        ({"old": "a"}, "'a' occurs 3 times"),
        ({"new": "a + b"}, "nothing is changed"),
        ({"new": "a +"}, "does not compile"),
        ({"file": "package/other.py"}, "no such file"),
        ({"tests": ()}, "names no tests"),
        ({"tests": ("tests/test_other.py",)}, r"there is no tests/test_other\.py"),
        ({"tests": ("tests/test_add.py::test_sub[1]",)}, r"tests/test_add\.py has no test_sub"),
    ],
)
def test_a_mutant_that_does_not_fit_is_named(change, message, tmp_path):
    _project(tmp_path, [])
    fits = {"file": "sb3_gac/add.py", "old": "a + b", "new": "a - b", "why": "subtracts", "tests": ("tests/test_add.py",)}
    mutant = Mutant(**{**fits, **change})
    with pytest.raises(MutantError, match=message):
        mutant.check(tmp_path)


def _project(root, mutants, test="assert add(1, 2) == 3"):
    for directory in ("sb3_gac", "tests"):
        (root / directory).mkdir()
        (root / directory / "__init__.py").touch()
    (root / "sb3_gac" / "add.py").write_text("def add(a, b):\n    return a + b\n")
    (root / "tests" / "test_add.py").write_text(f"from sb3_gac.add import add\n\n\ndef test_add():\n    {test}\n")
    template = '- file: sb3_gac/add.py\n  old: "a + b"\n  new: "{}"\n  why: "{}"\n  tests: [tests/test_add.py::test_add]\n'
    (root / "tests" / "mutants_of_add.yml").write_text("".join(template.format(*mutant) for mutant in mutants))


LOOP = "[1 for i in iter(int, 1)]"
KILLED, SURVIVOR, SLOW = ("a - b", "subtracts"), ("b + a", "the other way round"), (LOOP, "takes forever")


def test_survivors_are_named_and_the_tree_is_left_alone(tmp_path, capsys):
    _project(tmp_path, [KILLED, SURVIVOR])
    assert main(["--least", "60"], tmp_path) == 1
    printed = capsys.readouterr().out
    assert "1 of 2 mutants killed: 50.0 %." in printed
    assert "Survived: sb3_gac/add.py: the other way round" in printed
    assert "Survived: sb3_gac/add.py: subtracts" not in printed
    assert main(["--least", "50", "--only", "other way"], tmp_path) == 1
    assert main(["--only", "subtracts"], tmp_path) == 0
    assert "a + b" in (tmp_path / "sb3_gac" / "add.py").read_text()


def test_a_mutant_that_never_ends_is_killed(tmp_path):
    _project(tmp_path, [SLOW])
    assert main(["--timeout", "3"], tmp_path) == 0


@pytest.mark.parametrize(
    ("mutants", "arguments", "test", "message"),
    [
        ([KILLED], ["--only", "nowhere"], "pass", "No mutant has 'nowhere' in it"),
        ([KILLED], [], "assert False", "Tests fail without a mutant"),
        ([("a +", "breaks")], [], "pass", "does not compile"),
    ],
)
def test_what_tells_nothing_is_an_error(mutants, arguments, test, message, tmp_path, capsys):
    _project(tmp_path, mutants, test)
    assert main(arguments, tmp_path) == 2
    assert message in capsys.readouterr().out


def test_a_sample_is_the_same_each_time(tmp_path, capsys):
    _project(tmp_path, [("a - b", "subtracts"), ("b - a", "the other way"), ("a * b", "multiplies"), ("a / b", "divides")])
    drawn = []
    for _ in range(2):
        assert main(["--sample", "2", "--tests-pass"], tmp_path) == 0
        printed = capsys.readouterr().out
        assert "2 of 2 mutants killed" in printed
        assert "Without a mutant" not in printed
        drawn.append({line.split("s  ")[1] for line in printed.splitlines() if "killed" in line and "s  " in line})
    assert drawn[0] == drawn[1]
