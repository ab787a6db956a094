"""The documentation: every page can be found, every link leads somewhere, and the site is built without a warning."""

import os
import re
import subprocess
import sys
from html import unescape
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
GENERATED = {"changes.md"}
CODE = re.compile(r"^```.*?^```|`[^`\n]+`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


def _in_nav(entry):
    """Paths of pages in an entry of the navigation, whatever its depth."""
    if isinstance(entry, str):
        return [entry]
    parts = entry if isinstance(entry, list) else list(entry.values())
    return [path for part in parts for path in _in_nav(part)]


def test_every_page_is_in_the_navigation_once():
    listed = _in_nav(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    assert sorted(listed) == sorted({str(page.relative_to(ROOT / "docs")) for page in PAGES} | GENERATED)


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    links = [link for link in LINK.findall(CODE.sub("", page.read_text())) if not re.match(r"\w+:", link)]
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    for module in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(module, reason='the site needs the extra docs: pip install -e ".[docs]"')
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}  # what the theme's authors say of its future
    built = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True, check=False)
    said = [line for line in (built.stdout + built.stderr).splitlines() if "WARNING" in line or "ERROR" in line]
    assert (built.returncode, said) == (0, []), built.stderr
    return folder


def test_the_site_has_every_page_and_what_pages_show_of_the_repository(site):
    for page in PAGES:
        html = (site / page.relative_to(ROOT / "docs")).with_suffix(".html")
        shown = re.findall(r'<img[^>]* src="([^":]+)"', html.read_text())
        assert [source for source in shown if not (html.parent / source).resolve().is_file()] == [], html.name
    assert "(unreleased)" in (site / "changes.html").read_text()


def test_docstrings_are_shown_as_they_are_meant(site):
    pages = {path.stem: path.read_text() for path in (site / "api").glob("*.html")}
    assert re.search(r"<code>target_kl</code>\s*</td>", pages["algorithms"]), "a row of the table of GAC's arguments"
    assert 'href="#sb3_gac.base.off_policy.AsymmetricOffPolicyAlgorithm"' in pages["algorithms"], "of GAC's docstring"
    for name, html in pages.items():
        text = unescape(re.sub(r"<[^>]+>", "", html))
        assert re.findall(r":(?:class|meth|func|attr|mod|data):|:param \w+:|:return:", text) == [], name
