"""Every notebook runs from top to bottom and says what its text says."""

from pathlib import Path

import jupytext
import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.py"))


def run(name):
    names = {}
    for cell in jupytext.read(FOLDER / name).cells:
        if cell.cell_type == "code":
            exec(compile(cell.source, name, "exec"), names)
    return names


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_keep_no_outputs_and_define_short_functions_only(name):
    for cell in jupytext.read(FOLDER / name).cells:
        lines = cell.source.splitlines()
        if lines and lines[0].startswith("def "):
            assert len(lines) <= 6
        assert not cell.get("outputs")


def test_geometry_helps_where_places_alias_and_nowhere_hurts():
    names = run("when_geometry_helps.py")
    level, alias = names["scores"]["level separates"], names["scores"]["places alias"]
    assert level["top1_w10"] > 0.9
    assert alias["top1_w10"] < 0.8
    assert alias["tao"] > alias["top1_w10"] + 0.1
    assert min(level["recursive"], alias["recursive"]) > 0.9
    assert max(names["near"].values()) < 0.8
