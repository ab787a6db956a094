"""docs/theory.md and its tests: each verdict has one, and each is there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/theory.md").read_text()
TEST = re.compile(r"`([\w/]*test_\w+\.py)::(test_\w+)`")
VERDICTS = re.compile(r"\*\*(holds|with a correction|does not hold)\*\*")


def test_every_verdict_names_tests_that_exist():
    verdicts = [line for line in PAGE.splitlines() if VERDICTS.search(line)]
    assert len(verdicts) == 13
    for line in verdicts:
        assert TEST.search(line), line
    for file, name in TEST.findall(PAGE):
        path = ROOT / (file if "/" in file else f"tests/tabular/{file}")
        assert f"def {name}(" in path.read_text(), f"{file} has no {name}"


def test_its_figure_is_there():
    for link in re.findall(r"\]\((\S+?)\)", PAGE):
        assert (ROOT / "docs" / link).exists(), link
