"""The examples that load closures.g2o run as printed and agree; the benchmark writes its files."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import write_folder

from benchmarks import __main__ as benchmarks
from benchmarks import graph
from taojax.audit.graph import TITLES
from taojax.cli import main
from taojax.files import records
from taojax.files.specs import column_names
from taojax.files.tables import read_table

PAGE = (Path(__file__).parents[1] / "benchmarks/README.md").read_text(encoding="utf-8")
HAS_GTSAM = importlib.util.find_spec("gtsam") is not None
needs_gtsam = pytest.mark.skipif(
    not HAS_GTSAM, reason="GTSAM is not installed: python -m pip install 'taojax[graph]'"
)
FLAGS = ["--window", "6", "--branches", "5", "--association", "rank", "--no-progress"]
"""Rank compiles in a fraction of the time; what is tested does not depend on it."""


def block(start):
    found = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.S | re.M)
    (text,) = [text for text in found if text.startswith(start)]
    return text


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    data = write_folder(folder / "data", np.random.default_rng(3))
    assert main(["score", str(data), "--out", str(folder / "run"), *FLAGS]) == 0
    assert main(["evaluate", str(folder / "run"), "--truth", str(data / "truth")]) == 0
    assert main(["closures", str(folder / "run")]) == 0
    return folder


@pytest.fixture
def in_run(closed, monkeypatch):
    monkeypatch.chdir(closed / "run")
    return closed


def truth_m(closed):
    table = read_table(closed / "data/truth/query_poses.csv", "query_poses")
    return np.stack([table["x_m"], table["y_m"]], axis=1)


def by_scipy():
    names = {}
    exec(block("from pathlib import Path\n\nimport numpy as np\nfrom scipy"), names)
    return names


def test_plain_scipy_optimises_the_file_as_printed(in_run):
    names = by_scipy()
    assert names["poses"].shape == (50, 3)
    cost = lambda pose: (names["gaps"](pose[names["i"]], pose[names["j"]]) ** 2).sum()
    best = cost(names["pose"])
    assert best < 0.5 * cost(names["vertex"])
    # It has converged: no small move of any query frame makes it better.
    assert np.abs(names["step"]).max() < 1e-6
    for t in range(60, 110, 7):
        for move in 1e-2 * np.r_[np.eye(3), -np.eye(3)]:
            other = names["pose"].copy()
            other[t] += move
            assert cost(other) > best
    error = np.hypot(*(names["poses"][:, :2] - truth_m(in_run)).T)
    assert np.median(error) < 3.0


@needs_gtsam
def test_gtsam_optimises_the_file_as_printed_and_agrees_with_scipy(in_run):
    names = {}
    exec(block("import gtsam"), names)
    assert names["poses"].shape == (110, 3)
    sealed = records.read_run(in_run / "run")
    map_m = np.stack([sealed.map_poses[c] for c in ("x_m", "y_m")], axis=1)
    np.testing.assert_allclose(names["poses"][:60, :2], map_m, atol=0.05)
    np.testing.assert_allclose(names["poses"][60:, :2], by_scipy()["poses"][:, :2], atol=0.1)


# The benchmark


def made_up_rows():
    rng = np.random.default_rng(4)
    columns = [c for c in column_names("graph") if c != "method"]
    return [
        {"set": name, "method": method} | {c: float(rng.random()) for c in columns}
        for name in ("one", "simulated/two/0")
        for method in TITLES
    ]


def test_tables_and_figure_hold_every_set_and_method(tmp_path):
    rows = made_up_rows()
    rows[0]["wrong_share"] = float("nan")
    graph.write(tmp_path, rows)
    text = (tmp_path / "graph.md").read_text()
    assert text.count("| one |") == text.count("| simulated/two/0 |") == len(graph.TOLD)
    lines = (tmp_path / "graph.csv").read_text().splitlines()
    assert lines[0].split(",") == ["set", *column_names("graph")]
    assert len(lines) == 1 + 2 * len(TITLES)
    assert lines[1].split(",")[3] == ""
    assert (tmp_path / "graph.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "graph.svg").read_bytes()


def test_absent_recordings_are_named_and_left_out(tmp_path, capsys):
    kept = graph.recipes(tmp_path, quick=True)
    said = capsys.readouterr().out
    assert all(f"skipped {name}" in said for name in graph.REAL)
    assert [r.name for r in kept][:2] == ["simulated/default/0", "simulated/h3/0"]
    assert len(graph.recipes(tmp_path, quick=False, only="h3")) == 3


@needs_gtsam
def test_a_set_is_scored_judged_and_optimised(closed, tmp_path):
    recipe = graph.Recipe("made up", (10.0, 10.0), lambda _: closed / "data")
    rows = graph.measure(recipe, tmp_path)
    assert [row["method"] for row in rows] == list(TITLES)
    assert {row["set"] for row in rows} == {"made up"}
    assert (tmp_path / "run/graph.html").is_file()


def test_without_gtsam_the_benchmark_says_how_to_install_it(tmp_path, monkeypatch, capsys):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "gtsam" else found(name, *a)
    )
    words = ["graph", "--out", str(tmp_path / "out"), "--data", str(tmp_path)]
    assert benchmarks.main(words) == 4
    assert "taojax[graph]" in capsys.readouterr().err
