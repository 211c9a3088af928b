"""Every notebook runs from top to bottom and says what its text says."""

from pathlib import Path

import jupytext
import numpy as np
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
    names = run("05_when_geometry_helps.py")
    level, alias = names["scores"]["level separates"], names["scores"]["places alias"]
    assert level["top1_w10"] > 0.9
    assert alias["top1_w10"] < 0.8
    assert alias["tao"] > alias["top1_w10"] + 0.1
    assert min(level["recursive"], alias["recursive"]) > 0.9
    assert max(names["near"].values()) < 0.8


def test_the_quickstart_tells_off_map_from_in_map():
    names = run("01_quickstart.py")
    assert names["outside"] > 0.8
    assert names["inside"] < 0.5


def test_a_kidnapped_robot_comes_back_and_is_not_believed_before():
    names = run("02_replay_and_kidnap.py")
    assert len(names["found"]) >= 12
    assert np.isfinite(names["found"]).all()
    assert np.median(names["found"]) <= 4
    assert names["wrong"] < 1.0


def test_the_calibrated_probability_beats_the_gate_on_the_test_half():
    names = run("03_audit_and_calibration.py")
    assert names["far"] < names["gate"] / 3
    assert names["auroc"] > 0.95


def test_an_ablation_is_one_vmap_and_is_judged_on_the_other_half():
    names = run("04_ablations.py")
    assert names["table"].shape == (4, 4)
    assert names["table"][3, 0] < names["table"][0, 0]
    assert all(np.isfinite(names["slopes"]))


def test_a_plain_folder_becomes_a_data_folder_that_passes_inspection():
    names = run("06_your_own_data.py")
    assert names["inspected"] == 0
    assert (names["data"] / "query/odometry.csv").is_file()
    assert names["auroc"]["tao"] > names["auroc"]["top1"] + 0.05
    assert set(names["found"]) <= {"ok", "warming_up", "lost"}
