"""Pages of the site that live elsewhere in the repository, with what they link to.

mkdocs reads one folder; the measured results and the speed tables are kept where they are made.
Links between them are those of the repository, and are turned into the site's. The tutorial's page
shows the notebook: with its outputs where `python docs/notebook.py` has executed it.
"""

import posixpath
import re
import runpy
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the tests ask which pages there are, and have no mkdocs
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PLACES = {DOCS: "", ROOT / "experiments/results": "results", ROOT / "benchmarks": "speed"}
"""Folders of the repository that have pages, and where the site has them."""
LINK = re.compile(r"(?<=\]\()(?!https?:|#)[^)#\s]+")

NOTEBOOK_HERE = "<!-- the site shows the notebook here -->"
NOTEBOOK_PAGE, NOTEBOOK_FILE = "tutorial.md", "tutorial.ipynb"


@cache
def notebook() -> tuple[str, dict[str, bytes]]:
    """The tutorial as a page, and its pictures by name."""
    import nbformat
    from nbconvert import MarkdownExporter

    maker = runpy.run_path(str(ROOT / "docs" / "notebook.py"))
    file = maker["EXECUTED"]
    found = nbformat.read(file, as_version=4) if file.exists() else maker["cells"]()
    text, resources = MarkdownExporter().from_notebook_node(found)
    # The page has its title already; a program's first words are no part of a lesson.
    lesson = text[text.index("\n## ") :]
    link = f"\nWith its outputs: [{NOTEBOOK_FILE}]({NOTEBOOK_FILE}).\n" if file.exists() else ""
    return link + lesson, resources["outputs"]


def linked(folder: Path) -> set[Path]:
    """Files of `folder` that its README or a page of docs/ links to, through other pages too."""
    found, waiting = {folder / "README.md"}, [folder / "README.md", *DOCS.rglob("*.md")]
    while waiting:
        page = waiting.pop()
        places = [(page.parent / link).resolve() for link in LINK.findall(page.read_text())]
        new = {p for p in places if p.is_file() and p.is_relative_to(folder)} - found
        found |= new
        waiting += [p for p in new if p.suffix == ".md"]
    return found


def place_of(path: Path) -> str | None:
    """Where the site has a file of the repository."""
    for folder, place in PLACES.items():
        if path.is_relative_to(folder):
            return posixpath.join(place, path.relative_to(folder).as_posix())
    return None


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    from mkdocs.structure.files import File

    for folder, place in PLACES.items():
        if place:
            for path in sorted(linked(folder)):
                uri = f"{place}/{path.relative_to(folder).as_posix()}"
                files.append(File.generated(config, uri, abs_src_path=str(path)))
    _, pictures = notebook()
    for name, content in pictures.items():
        files.append(File.generated(config, name, content=content))
    executed = ROOT / "build" / "notebook" / NOTEBOOK_FILE
    if executed.exists():
        files.append(File.generated(config, NOTEBOOK_FILE, abs_src_path=str(executed)))
    return files


def on_page_markdown(markdown: str, page: "Page", **_: Any) -> str:
    if page.file.src_uri == NOTEBOOK_PAGE:
        return markdown.replace(NOTEBOOK_HERE, notebook()[0])
    lies_in = Path(page.file.abs_src_path or ROOT).parent
    uri = posixpath.dirname(page.file.src_uri)

    def of_the_site(match: re.Match[str]) -> str:
        place = place_of((lies_in / match[0]).resolve())
        return match[0] if place is None else posixpath.relpath(place, uri or ".")

    return LINK.sub(of_the_site, markdown)
