"""Every notebook runs in a real kernel, shows its figures there and on the web, and is right."""

import copy

import nbformat
import pytest

from benchmarks.notebooks import FOLDER, execute, pictures, read_source

SOURCES = sorted(FOLDER.glob("*.py"))

HOLDS = {
    # Off-map is told from in-map.
    "01_quickstart": ("outside > 0.8", "inside < 0.5"),
    # A kidnapped robot comes back, and is not believed before.
    "02_replay_and_kidnap": (
        "len(found) >= 12",
        "np.isfinite(found).all()",
        "np.median(found) <= 8",
        "wrong < 1.0",
    ),
    # The calibrated probability beats the gate on the test half.
    "03_audit_and_calibration": ("far < gate / 3", "auroc > 0.95"),
    # An ablation is one vmap; refining lowers the cost and leaves the detector where it was.
    "04_ablations": (
        "table.shape == (4, 4)",
        "table[3, 0] < table[0, 0]",
        "all(np.isfinite(slopes))",
        "(refined <= closed * (1 + 1e-5)).all()",
        "lower.mean() > 0.2",
        "abs(gained['refined'] - gained['closed form']) < 0.02",
    ),
    # Geometry helps where places alias, and hurts nowhere.
    "05_when_geometry_helps": (
        "scores['level separates']['top1_w10'] > 0.9",
        "scores['places alias']['top1_w10'] < 0.8",
        "scores['places alias']['tao'] > scores['places alias']['top1_w10'] + 0.1",
        "scores.loc['tao'].min() > 0.9",
        "max(near.values()) < 0.8",
    ),
    # A plain folder becomes a data folder that passes inspection; a run comes back as tables.
    "06_your_own_data": (
        "converted == inspected == 0",
        "Path('data/query/odometry.csv').is_file()",
        "run.metrics['auroc']['tao'] > run.metrics['auroc']['top1'] + 0.05",
        "set(run.signals['status']) <= {'ok', 'warming_up'}",
        "len(run.signals) == len(run.labels) == len(run.verdicts) == 300",
    ),
}
"""Notebook -> what must be true of its names after the last cell."""


def committed(source):
    """Return the notebook that people see on the web."""
    return nbformat.read(source.with_suffix(".ipynb"), as_version=4)


def kinds(notebook):
    """Return what each cell shows: MIME types, or the stream's name."""
    return [
        [sorted(output.get("data", [output.get("name")])) for output in cell.get("outputs", ())]
        for cell in notebook.cells
    ]


def with_question(notebook, conditions):
    """Return a copy with a last cell that lists the conditions which do not hold."""
    asked = copy.deepcopy(notebook)
    source = f"[text for text in {list(conditions)!r} if not eval(text)]"
    asked.cells.append(nbformat.v4.new_code_cell(source, id="question"))
    return asked


def test_every_notebook_has_its_conditions():
    assert [source.stem for source in SOURCES] == list(HOLDS)


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_the_page_on_the_web_is_its_source_executed(source):
    fresh, shown = read_source(source), committed(source)
    assert [(c.cell_type, c.source) for c in shown.cells] == [
        (c.cell_type, c.source) for c in fresh.cells
    ], "run `python -m benchmarks notebooks`"
    counts = [cell.execution_count for cell in shown.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert pictures(shown) == source.read_text().count("plt.show()") >= 1
    assert source.with_suffix(".ipynb").stat().st_size < 600_000


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_sources_keep_no_outputs_and_define_short_functions_only(source):
    for cell in read_source(source).cells:
        lines = cell.source.splitlines()
        if lines and lines[0].startswith("def "):
            assert len(lines) <= 6
        assert not cell.get("outputs")


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_a_real_kernel_shows_the_figures_and_finds_what_the_text_says(source, monkeypatch):
    monkeypatch.setenv("JAX_NUMPY_RANK_PROMOTION", "raise")
    monkeypatch.setenv("JAX_NUMPY_DTYPE_PROMOTION", "strict")
    monkeypatch.setenv("MPLBACKEND", "Agg")  # as the gate sets it
    done = execute(with_question(read_source(source), HOLDS[source.stem]))
    *_, answer = done.cells
    assert answer.outputs[0]["data"]["text/plain"] == "[]"
    assert "Warning" not in "".join(
        output.get("text", "") for cell in done.cells for output in cell.get("outputs", ())
    )
    assert kinds(done)[:-1] == kinds(committed(source))


def test_a_figure_without_pyplot_is_noticed():
    notebook = nbformat.v4.new_notebook()
    cell = "from matplotlib.figure import Figure\nFigure()"
    notebook.cells = [nbformat.v4.new_code_cell(cell, id="bare")]
    assert pictures(execute(notebook)) == 0
    assert kinds(notebook) == [[["text/plain"]]]
