"""The paper's protocol: numbers frozen once serve every scenario, beside each scenario's own."""

import judged
import numpy as np
import pytest

from taojax.audit import calibration, figures, protocol
from taojax.audit.evaluate import evaluate
from taojax.audit.html import about
from taojax.audit.report import write_summary
from taojax.audit.summary_text import PAPER_TABLE_2, mapout_table, metric_row
from taojax.files.tables import read_table
from taojax.risk import probability


@pytest.fixture(scope="module")
def scenarios(tmp_path_factory):
    """Three scenarios of other seeds; the first is never off its map."""
    folder, found = tmp_path_factory.mktemp("protocol"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "draw", lambda judgement: (figures.retrieval(judgement),))
        for at, name in enumerate(("full", "default", "h3")):
            (folder / name).mkdir()
            run, truth = judged.seal(folder / name, always_in=name == "full", seed=7 + at)
            found[name] = evaluate(run, truth, judged.config())
    return found


def row_of(table, scenario, signal):
    (at,) = np.flatnonzero((table["scenario"] == scenario) & (table["signal"] == signal))
    return {name: values[at] for name, values in table.items()}


def half(done, name, wanted):
    """Return a signal on in-map or map-out frames of a half, from the sealed table."""
    judgement = done.judgement
    chosen = judgement.splits.name == name
    return chosen & (np.asarray(judgement.label) == wanted)


@pytest.mark.parametrize("signal", ["top1", "velocity", "tao_rank", "tao"])
def test_a_gate_is_frozen_once_on_the_calibration_half_of_the_whole_map(signal, scenarios):
    table = protocol.frozen_table(scenarios)
    full = scenarios["full"].judgement
    inside = np.asarray(full.signals[signal], float)[
        half(scenarios["full"], "calibration", "in_map")
    ]
    want = inside.mean() + 3.0 * inside.std()
    for name in ("default", "h3"):
        row, values = row_of(table, name, signal), scenarios[name].judgement.signals[signal]
        assert row["once_on"] == "full"
        assert row["once_threshold"] == pytest.approx(want)
        for rate, wanted, accepts in (("far", "map_out", True), ("frr", "in_map", False)):
            tested = values[half(scenarios[name], "test", wanted)]
            assert row[f"once_{rate}"] == pytest.approx(np.mean((tested <= want) == accepts))
        own = values[half(scenarios[name], "calibration", "in_map")]
        assert row["threshold"] == pytest.approx(own.mean() + 3.0 * own.std())
        assert row["once_auroc_test"] == row["auroc_test"]
        assert row["threshold"] != row["once_threshold"]


@pytest.mark.parametrize("model", ["single_view", "joint_features", "fused"])
def test_a_model_is_frozen_once_on_the_first_scenario_with_both_classes(model, scenarios):
    table = protocol.frozen_table(scenarios)
    first = row_of(table, "default", model)
    for key in ("far", "frr", "threshold", "auroc_test"):
        assert first[f"once_{key}"] == pytest.approx(first[key])
    numbers = protocol.model_of(scenarios["default"].judgement, model)
    done, row = scenarios["h3"], row_of(table, "h3", model)
    assert row["once_on"] == "default"
    assert row["once_threshold"] == numbers.threshold
    p = probability(numbers, done.judgement.signals | done.judgement.delayed)
    tested = p[half(done, "test", "map_out")]
    assert row["once_far"] == pytest.approx(np.mean(tested <= numbers.threshold))
    assert row["once_threshold"] != row["threshold"]


def test_the_paper_s_figures_stand_beside_the_gate_and_eq_1_alone(scenarios):
    table = protocol.frozen_table(scenarios)
    for scenario, at in (("default", 0), ("h3", 1)):
        assert row_of(table, scenario, "top1")["paper_far"] == (0.583, 0.238)[at]
        assert row_of(table, scenario, "tao_rank")["paper_far"] == (0.259, 0.049)[at]
        assert np.isnan(row_of(table, scenario, "tao")["paper_far"])
    assert PAPER_TABLE_2["h4"] == (271, 0.946, 0.983, 0.326, 0.119)


def test_what_is_said_names_both_protocols_and_the_paper(scenarios):
    table = protocol.frozen_table(scenarios)
    literal, ours = protocol.frozen_words(table)
    row = row_of(table, "h3", "tao_rank")
    assert f"{row['once_far']:.3f} at one threshold, frozen once" in literal
    assert f"{row['far']:.3f} at thresholds of each scenario's own half" in literal
    assert literal.endswith("the paper 0.259, 0.049.")
    assert "tao_rank" not in ours
    assert "paper 0" not in ours


def test_one_scenario_alone_has_no_second_protocol(scenarios):
    for name in ("default", "full"):
        table = protocol.frozen_table({name: scenarios[name]})
        assert not len(table["signal"])
        assert protocol.frozen_words(table) == []


def test_without_the_whole_map_the_first_scenario_freezes_everything(scenarios):
    table = protocol.frozen_table({name: scenarios[name] for name in ("default", "h3")})
    assert set(table["once_on"]) == {"default"}
    row = row_of(table, "default", "tao")
    assert row["once_threshold"] == row["threshold"]


def test_the_summary_holds_the_table_and_the_sentences(scenarios, tmp_path):
    words = write_summary(tmp_path, scenarios)
    table = read_table(tmp_path / "tables/frozen.csv", "frozen")
    assert len(table["signal"]) == 2 * len(protocol.COMPARED)
    assert sum("frozen once" in sentence for sentence in words) == 2
    page = (tmp_path / "report.html").read_text()
    assert "one frozen set, as in the paper" in page


def test_the_paper_s_two_logistic_models_read_what_the_paper_offers():
    view, joint = calibration.LOGISTIC["single_view"], calibration.LOGISTIC["joint_features"]
    assert set(view) == {"top1", "margin", "entropy"}
    assert set(joint) - set(view) == {"velocity", "c_geom", "a_aniso", "h_proxy", "tao_rank"}


def test_the_column_fused_is_not_called_the_verdicts(scenarios):
    said = about("fused_far", "mapout")
    assert "cannot abstain" in said
    assert "Not the verdicts" in said
    table = mapout_table(scenarios)
    for row, name in enumerate(("default", "h3")):
        judgement = scenarios[name].judgement
        assert table["fused_far"][row] == metric_row(judgement, "fused")["far"]
