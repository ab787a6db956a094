"""What MkDocs does not do by itself for these pages: links out of docs/, the changelog, the markup of docstrings."""

import posixpath
import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()(\.\./[^)#\s]+)")
CHANGELOG, CHANGES = "CHANGELOG.md", "changes.md"
CODE = re.compile(r"(``.*?``)", re.DOTALL)
ROLE = re.compile(r":(?:class|meth|func|attr|mod|data|exc|obj):`([~.\w]+)`")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """
    Take along the changelog, and every file of the repository that a page links to.

    :param files: of the site
    :param config: of the site
    :return: all of them
    :raises FileNotFoundError: if a page links to a file that is not there
    """
    files.append(File.generated(config, CHANGES, content=(ROOT / CHANGELOG).read_text()))
    for page in files.documentation_pages():
        for path in sorted(_files_outside(page)):
            if not (ROOT / path).is_file():
                raise FileNotFoundError(f"{page.src_uri} links to {path}, which is not in the repository.")
            if files.get_file_from_path(path) is None:
                files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def _files_outside(page: File) -> set[str]:
    """:return: paths below the repository's root, of files that are not below docs/"""
    folder = posixpath.dirname(f"docs/{page.src_uri}")
    linked = (posixpath.normpath(f"{folder}/{link}") for link in LINK.findall(page.content_string))
    return {path for path in linked if not path.startswith("docs/")}


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """
    :param markdown: of a page
    :param page: that it is
    :param config: of the site
    :param files: of the site
    :return: with links to files of the repository as links to their copies in the site
    """
    folder = posixpath.dirname(f"docs/{page.file.src_uri}")

    def within_the_site(link: re.Match) -> str:
        path = posixpath.normpath(f"{folder}/{link[1]}")
        return link[1] if path.startswith("docs/") else posixpath.relpath(path, posixpath.dirname(page.file.src_uri) or ".")

    return LINK.sub(within_the_site, markdown)


class DocstringMarkup(griffe.Extension):
    """Docstrings have Sphinx's roles, and a double colon before code: here they become links and Markdown."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """
        :param obj: with a docstring, or without one
        :param kwargs: the loader
        """
        if obj.docstring is not None:
            text = re.sub(r"::$", ":", obj.docstring.value, flags=re.MULTILINE)
            parts = CODE.split(text)  # every other one is code, which stays as it is
            parts[::2] = [ROLE.sub(lambda role: _link(role[1], obj), part.replace("<", "&lt;")) for part in parts[::2]]
            obj.docstring.value = "".join(parts)


def _link(name: str, obj: griffe.Object) -> str:
    """A link where the API's pages have that name, and plain code elsewhere."""
    shown, name = (name[1:].rpartition(".")[2], name[1:]) if name.startswith("~") else (name, name)
    first, _, rest = name.partition(".")
    try:
        path = obj.resolve(first)
    except griffe.NameResolutionError:
        path = first
    target = f"{path}.{rest}" if rest else path
    return f'<autoref optional identifier="{target}"><code>{shown}</code></autoref>'
