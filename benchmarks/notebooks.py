"""`python -m benchmarks notebooks`: the notebooks, executed from their sources, with figures.

People edit `notebooks/*.py`; the `.ipynb` beside each is what the web shows.
"""

import os
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

from taojax.files.specs import write_atomically

FOLDER = Path(__file__).parents[1] / "notebooks"

TIMEOUT_S = 300
"""Longest that one cell may take."""


def read_source(source: Path) -> NotebookNode:
    """Return a source as a notebook without outputs; the same source gives the same bytes."""
    notebook = jupytext.read(source)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
    return notebook


def execute(notebook: NotebookNode) -> NotebookNode:
    """Run all cells in a fresh kernel, as Jupyter does, and keep their outputs in the notebook.

    Raises:
        CellExecutionError: a cell failed; the message shows it and its traceback.
    """
    # A backend that the terminal chose would show nothing; Jupyter sets its own.
    env = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    NotebookClient(
        notebook, kernel_name="python3", timeout=TIMEOUT_S, record_timing=False,
        coalesce_streams=True, resources={"metadata": {"path": str(FOLDER)}},
    ).execute(env=env)  # fmt: skip
    # Which Python it was would change with every machine.
    notebook.metadata["language_info"] = {"name": "python"}
    return notebook


def pictures(notebook: NotebookNode) -> int:
    """Return how many PNG outputs a notebook shows."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return sum("image/png" in output.get("data", {}) for output in outputs)


def run(only: str = "") -> None:
    """Execute notebooks and write each beside its source.

    Args:
        only: part of a name; all where it is empty.
    """
    for source in sorted(path for path in FOLDER.glob("*.py") if only in path.stem):
        notebook = execute(read_source(source))
        path = source.with_suffix(".ipynb")
        write_atomically(path, nbformat.writes(notebook) + "\n")
        print(f"{path.name}: {pictures(notebook)} figures, {path.stat().st_size / 1e3:.0f} kB")
