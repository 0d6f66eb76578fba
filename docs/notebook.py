"""The tutorial as a notebook with its outputs, made from experiments/tutorial.py and executed.

    python docs/notebook.py [FILE]

Without FILE it is build/notebook/tutorial.ipynb, which the site shows. What the cells write goes to
runs/ beside it. Needs the extra `docs`.
"""

import os
import re
import sys
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "experiments" / "tutorial.py"
EXECUTED = ROOT / "build" / "notebook" / "tutorial.ipynb"
PATIENCE = 1800
"""Seconds for a cell: the longest trains twice, for a minute on two cores."""
ONCE_PRINTED = re.compile(r"\n\n(?:#.*(?:\n|\Z))+\Z")
"""The comment that ends a cell: what it printed, for readers of the program."""


def cells() -> NotebookNode:
    """The notebook without outputs."""
    return jupytext.read(SOURCE)


def executed(folder: Path) -> NotebookNode:
    """The notebook with outputs; each stands for the comment that ended its cell.

    Raises:
      CellExecutionError: where a cell does.
    """
    notebook = cells()
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.source = ONCE_PRINTED.sub("", cell.source)
    notebook.metadata["kernelspec"] = {
        "name": "python3",
        "display_name": "Python 3",
        "language": "python",
    }
    # The kernel is a process of its own, and starts in `folder`.
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    where = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=PATIENCE, resources=where).execute()
    return notebook


def main(file: Path = EXECUTED) -> None:
    """Writes it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(executed(file.parent), file)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
