"""Every figure comes as PNG, SVG and CSV, with units, and the tables can be pasted."""

import io
import re

import judged
import numpy as np
import pandas as pd
import pytest

from taojax.audit import figures, summary_text
from taojax.audit.evaluate import paste_files
from taojax.audit.judgement import Evaluation, judge
from taojax.audit.labels import read_truth
from taojax.audit.summary_text import MAIN, metric_row
from taojax.files import records


def judgement_of(folder, **changes):
    run, truth = judged.seal(folder, **changes)
    sealed = records.read_run(run)
    return judge(sealed, read_truth(truth, len(sealed.signals["frame"])), judged.config())


@pytest.fixture(scope="module")
def judgement(tmp_path_factory):
    return judgement_of(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def drawn(judgement):
    return {picture.name: picture for picture in figures.draw(judgement)}


def csv(picture):
    return pd.read_csv(io.StringIO(picture.csv))


def test_every_figure_is_a_png_an_svg_and_the_numbers_behind_it(drawn):
    assert set(drawn) == {"map", "diagnostics", "roc", "pr", "reliability", "retrieval", "micro"}
    for picture in drawn.values():
        assert picture.png.startswith(b"\x89PNG")
        assert b"<svg" in picture.svg
        assert len(csv(picture)) > 1
        assert picture.caption.endswith(".")


def test_no_figure_reaches_for_the_network(drawn):
    for picture in drawn.values():
        found = set(re.findall(rb"(?:href|src)=\"([^\"#]+)", picture.svg))
        assert not [name for name in found if not name.startswith(b"data:")]


def test_the_strict_figure_holds_the_curves_of_the_micro_table(judgement, drawn):
    table = csv(drawn["micro"])
    assert sorted(set(table["radius_m"])) == [2.5, 5.0]
    assert set(table["signal"]) == set(figures.STRICT)
    for (radius, name), part in table.groupby(["radius_m", "signal"]):
        at = (judgement.micro["radius_m"] == radius) & (judgement.micro["signal"] == name)
        area = np.trapezoid(part["rejected_beyond"], part["rejected_within"])
        np.testing.assert_allclose(area, judgement.micro["auroc"][at][0], atol=1e-4)


def test_strict_labels_with_one_class_draw_nothing(tmp_path):
    whole = judgement_of(tmp_path, always_in=True, n=60)
    assert figures.strict(whole._replace(nearest_m=np.zeros(60))) == ()


def test_the_trace_figure_holds_every_frame_of_every_scenario(judgement, tmp_path):
    done = Evaluation(tmp_path, judgement, (), "taojax audit")
    picture = figures.traces({"default": done, "h3": done})
    table = csv(picture)
    assert len(table) == 2 * len(judgement.label)
    assert set(table["scenario"]) == {"default", "h3"}
    tao = table.loc[table["scenario"] == "h3", "tao"]
    np.testing.assert_allclose(tao, judgement.signals["tao"], rtol=1e-5)


def test_the_maps_figure_holds_true_and_answered_positions(judgement, tmp_path):
    done = Evaluation(tmp_path, judgement, (), "taojax audit")
    table = csv(summary_text.maps({"default": done}))
    test = judgement.splits.test.frame
    np.testing.assert_array_equal(table["frame"], test)
    true = table[["true_x_m", "true_y_m"]].to_numpy()
    np.testing.assert_allclose(true, judgement.query_m[test], atol=1e-2)
    np.testing.assert_allclose(table["x_m"], judgement.signals["x_m"][test], atol=1e-2)


def test_the_trace_figure_draws_a_run_without_thresholds(judgement, tmp_path):
    metrics = judgement.metrics | {"threshold": np.full(len(judgement.metrics["signal"]), np.nan)}
    blind = Evaluation(tmp_path, judgement._replace(metrics=metrics), (), "taojax audit")
    assert figures.traces({"default": blind}).png


def test_the_pasted_tables_hold_the_main_signals_with_their_intervals(judgement):
    files = paste_files(judgement, "taojax evaluate run")
    row = metric_row(judgement, "top1")
    cell = f"{row['auroc']:.3f} [{row['auroc_lo']:.3f}, {row['auroc_hi']:.3f}]"
    for name in ("tables/main.md", "tables/main.tex"):
        assert cell in files[name]
        assert "taojax evaluate run" in files[name]
    markdown = files["tables/main.md"].splitlines()
    lines = [line for line in markdown if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1
    assert [line.split("|")[1].strip() for line in lines[2:]] == list(MAIN)


def test_the_latex_table_escapes_and_balances(judgement):
    latex = paste_files(judgement, "taojax evaluate my_run")["tables/main.tex"]
    body = [line for line in latex.splitlines() if not line.startswith("%")]
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", latex)[1]
    rows = [line for line in body if line.endswith(r"\\")]
    assert len(rows) == 1 + len(MAIN)
    assert {line.count(" & ") + 1 for line in rows} == {len(columns)}
    assert not re.search(r"(?<!\\)[%_]", "".join(body))
