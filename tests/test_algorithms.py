"""The one table of algorithms, by which programs know them."""

import re
import subprocess
import sys

import pytest

import sb3_gac
from sb3_gac import GAC, AsymmetricSAC
from sb3_gac.algorithms import ALGORITHMS, algorithm_class, import_path, name_of


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_is_a_public_class_and_knows_its_name(name):
    kind = algorithm_class(name)
    assert getattr(sb3_gac, kind.__name__) is kind
    assert kind.__name__ in sb3_gac.__all__
    assert name_of(kind) == name


def test_somebody_elses_class_is_named_with_its_module():
    assert algorithm_class("sb3_gac:GAC") is GAC
    assert name_of(type("Mine", (AsymmetricSAC,), {"__module__": "mine"})) == "mine:Mine"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("GAC", "must be one of [.*'gac'.*], or module:Class, got 'GAC'"),
        ("no_such:Mine", "'no_such:Mine': there is no module 'no_such'"),
        ("sb3_gac.gac:Mine", "'sb3_gac.gac:Mine': the module sb3_gac.gac has no 'Mine'"),
        ("sb3_gac:preset", "'sb3_gac:preset' is no class"),
        (":GAC", "must be module:name.*got ':GAC'"),
        ("sb3_gac:", "must be module:name.*got 'sb3_gac:'"),
    ],
)
def test_what_is_no_class_is_refused(name, message):
    with pytest.raises(ValueError, match=re.escape(message).replace(r"\.\*", ".*")):
        algorithm_class(name)


def test_a_module_that_fails_by_itself_is_not_taken_for_a_wrong_name(tmp_path, monkeypatch):
    (tmp_path / "half_written.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ZeroDivisionError):
        import_path("half_written:Mine")


def test_the_table_imports_no_algorithm():
    program = "import sys, sb3_gac.algorithms; assert not {'sb3_gac.gac.gac', 'torch'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
