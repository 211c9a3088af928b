"""A sealed run judged end to end: files, contract, plain sentences and the summary."""

import json
import re
from html.parser import HTMLParser

import judged
import numpy as np
import pytest

from taojax.audit.evaluate import evaluate
from taojax.audit.report import write_summary
from taojax.audit.tables import to_latex, to_markdown
from taojax.errors import InputError
from taojax.files import records
from taojax.files.tables import read_table
from taojax.risk import read_calibration

FILES = {
    "labels.csv", "verdicts.csv", "metrics.csv", "audit.json", "calibration.toml", "report.html",
    "tables/main.md", "tables/main.tex", "tables/risk_coverage.csv",
    *(f"tables/{n}.{e}"
      for n in ("metrics", "recall", "micro", "errors", "conformal", "counts", "rates",
                "verdicts")
      for e in ("csv", "md", "tex")),
    *(f"figures/{n}.{e}"
      for n in ("map", "diagnostics", "roc", "pr", "reliability", "retrieval", "micro")
      for e in ("png", "svg", "csv")),
}  # fmt: skip


def contents(folder):
    files = (p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


@pytest.fixture
def no_figures(monkeypatch):
    """Most of the time goes into drawing; tests of numbers and words leave it out."""
    monkeypatch.setattr("taojax.audit.figures.draw", lambda judgement: ())


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    run, truth = judged.seal(tmp_path_factory.mktemp("case"))
    before = contents(run)
    return run, truth, before, evaluate(run, truth, judged.config())


def test_every_file_of_the_contract_is_written_and_the_sealed_ones_stay(case):
    run, _, before, _ = case
    after = contents(run)
    assert set(after) - set(before) == FILES
    assert {name: after[name] for name in before} == before


def test_every_table_meets_its_spec(case):
    run = case[0]
    paths = {"labels": "labels.csv", "verdicts": "verdicts.csv", "metrics": "metrics.csv"}
    paths |= {name: f"tables/{name}.csv" for name in ("recall", "micro", "errors")}
    paths |= {"verdict_table": "tables/verdicts.csv", "risk_coverage": "tables/risk_coverage.csv"}
    tables = {name: read_table(run / path, name) for name, path in paths.items()}
    lengths = {name: len(next(iter(table.values()))) for name, table in tables.items()}
    n_signals = len(records.signal_names())
    assert lengths == {
        "labels": 240, "verdicts": 240, "metrics": n_signals + 5, "recall": 3,
        "micro": 2 * n_signals, "errors": 4, "verdict_table": 2,
        "risk_coverage": 100 * (n_signals + 5),
    }  # fmt: skip


def test_judging_again_elsewhere_gives_the_same_bytes(case, tmp_path):
    run, truth, _, _ = case
    evaluate(run, truth, judged.config(), out=tmp_path / "elsewhere")
    first = contents(run)
    assert contents(tmp_path / "elsewhere") == {name: first[name] for name in FILES}


def test_judging_again_with_other_radii_replaces_the_labels(tmp_path, no_figures):
    run, truth = judged.seal(tmp_path, n=60)
    evaluate(run, truth, judged.config())
    before = (run / "labels.csv").read_bytes()
    evaluate(run, truth, judged.config(r_in_m=1.0))
    assert (run / "labels.csv").read_bytes() != before


def test_labels_add_up_and_the_gap_is_one_window(case):
    table = read_table(case[0] / "labels.csv", "labels")
    counts = {name: int((table["label"] == name).sum()) for name in ("in_map", "map_out", "grey")}
    metrics = read_table(case[0] / "metrics.csv", "metrics")
    assert min(counts.values()) > 0
    assert sum(counts.values()) == 240
    assert (metrics["n_in"][0], metrics["n_out"][0]) == (counts["in_map"], counts["map_out"])
    assert int((table["split"] == "gap").sum()) == 10


def test_a_strong_signal_scores_high_and_holds_its_interval(case):
    table = read_table(case[0] / "metrics.csv", "metrics")
    row = {name: values[list(table["signal"]).index("tao")] for name, values in table.items()}
    assert row["auroc"] > 0.9
    assert row["auroc_lo"] <= row["auroc"] <= row["auroc_hi"]
    assert 0 <= row["far_lo"] <= row["far"] <= row["far_hi"] <= 1
    assert row["n_exits"] > 0
    assert row["delay_frames"] >= 0


def test_the_probability_is_scored_on_the_test_split_alone(case):
    table = read_table(case[0] / "metrics.csv", "metrics")
    at = list(table["signal"]).index("fused")
    assert at == len(table["signal"]) - 1
    for name in ("n_in", "n_out", "auroc", "aupr_out", "far_at_95"):
        assert np.isnan(table[name][at])
    for name in ("auroc_test", "threshold", "far", "frr", "ece", "brier"):
        assert np.isfinite(table[name][at])
    # The paper's two logistic models stand before it, and are told like it.
    assert table["signal"][at - 2 : at].tolist() == ["single_view", "joint_features"]
    assert np.isfinite(table["ece"][at - 2 :]).all()
    assert np.isnan(table["n_in"][at - 2 :]).all()
    assert np.isnan(table["ece"][: at - 2]).all()


def test_verdicts_cover_every_frame_and_warming_up_abstains(case):
    table = read_table(case[0] / "verdicts.csv", "verdicts")
    assert table["verdict"][:2].tolist() == ["abstain", "abstain"]
    assert set(table["verdict"][2:]) == {"accept", "reject", "abstain"}
    for end in ("", "_now"):
        left = table[f"reason{end}"][table[f"verdict{end}"] == "abstain"]
        assert {reason.split(":")[0] for reason in left[:2]} == {"warming_up"}
        assert all("neither sure enough to accept" in reason for reason in left[2:])
        p = table[f"probability_wrong{end}"]
        assert (
            p[table[f"verdict{end}"] == "accept"].max()
            < p[2:][table[f"verdict{end}"][2:] == "abstain"].min()
        )


def test_the_answers_are_scored_by_right_and_wrong(case):
    table = read_table(case[0] / "metrics.csv", "metrics")
    rows = {str(row[0]): dict(zip(table, row, strict=True)) for row in
            zip(*table.values(), strict=True)}  # fmt: skip
    for name in ("probability_wrong_now", "probability_wrong", "tao", "fused"):
        for column in ("aurc", "recall_at_p95", "recall_at_p99"):
            assert 0 <= rows[name][column] <= 1, (name, column)
    assert rows["probability_wrong"]["aurc"] < rows["margin"]["aurc"]
    assert rows["probability_wrong"]["recall_at_p95"] > rows["margin"]["recall_at_p95"]


def test_the_table_of_verdicts_counts_what_verdicts_and_truth_say(case):
    run, _, _, done = case
    table, verdicts = (
        read_table(run / path, spec)
        for path, spec in (("tables/verdicts.csv", "verdict_table"), ("verdicts.csv", "verdicts"))
    )
    judgement = done.judgement
    test = judgement.splits.test.frame
    for row, end in (("now", "_now"), ("final", "")):
        at = list(table["verdict"]).index(row)
        error = np.hypot(
            verdicts[f"x{end}_m"] - judgement.query_m[:, 0],
            verdicts[f"y{end}_m"] - judgement.query_m[:, 1],
        )[test]
        accepted = verdicts[f"verdict{end}"][test] == "accept"
        near = judgement.nearest_m[test] <= 10.0
        assert table["wrong"][at] == (accepted & (error > 10.0)).sum()
        assert table["right"][at] == (accepted & (error <= 10.0) & near).sum()
        assert table["accepted"][at] == table["right"][at] + table["wrong"][at]
        assert table["max_wrong"][at] == 0.05
        assert table["promise"][at]
    frozen = read_calibration(run / "calibration.toml")
    assert frozen.final.promise.replace(",", ";") == table["promise"][1]
    assert frozen.map_out is not None


def test_a_smaller_share_of_wrong_answers_accepts_no_more(case, tmp_path, no_figures):
    run, truth, _, done = case
    strict = evaluate(run, truth, judged.config(max_wrong=0.01), out=tmp_path / "strict")
    many = lambda found: (found.judgement.verdicts["verdict"] == "accept").sum()
    assert many(strict) < many(done)
    none = evaluate(run, truth, judged.config(max_wrong=0.001), out=tmp_path / "none")
    assert many(none) == 0
    assert none.sentences[0].startswith("No closure is accepted on the ")
    assert none.sentences[1].startswith("Promised: nothing is accepted: ")


def test_the_micro_audit_has_no_grey_zone(case):
    table = read_table(case[0] / "tables/micro.csv", "micro")
    assert sorted(set(table["radius_m"])) == [2.5, 5.0]
    assert (table["n_in"] + table["n_out"] == 240).all()


def test_recall_never_exceeds_the_answerable_share(case):
    table = read_table(case[0] / "tables/recall.csv", "recall")
    assert (table["r_at_100"] <= table["answerable"] / table["n"] + 1e-6).all()
    assert (table["r_at_1"] <= table["r_at_5"]).all()


class _Links(HTMLParser):
    def __init__(self):
        super().__init__()
        self.sources, self.titles = [], 0

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            is_inside = value is not None and value.startswith("#")
            self.sources += [value] if name in ("src", "href") and not is_inside else []
            self.titles += name == "title"


def test_the_report_needs_no_network_and_defines_its_columns(case):
    html = (case[0] / "report.html").read_text()
    page = _Links()
    page.feed(html)
    assert len(page.sources) == 6
    assert all(source.startswith("data:image/svg+xml;base64,") for source in page.sources)
    assert page.titles > 50
    assert "prefers-color-scheme: dark" in html
    assert "@import" not in html


def test_the_report_prints_seal_note_and_every_sentence(case):
    run, _, _, done = case
    html = (run / "report.html").read_text()
    assert json.loads((run / "manifest.json").read_text())["seal"] in html
    assert "simulated" in html
    plain = re.sub(r"&[#\w]+;|<[^>]*>", "", html)
    for sentence in done.sentences:
        assert re.sub(r"[<>&'\"]", "", sentence) in plain


def test_the_sentences_say_how_many_were_accepted_and_the_false_acceptance_rate(case):
    text = " ".join(case[3].sentences)
    assert re.match(
        r"\d+ of \d+ accepted answers are right, and \d+ of \d+ right answers are accepted; "
        r"at most 5 % wrong are promised, .*\. Promised: at most 5% of the accepted answers wrong",
        text,
    )
    assert re.search(r"taojax accepted \d+, rejected \d+ and abstained on \d+\.", text)
    assert "False acceptance rate" in text


def test_the_settings_of_the_judge_are_kept_with_the_seal(case):
    run = case[0]
    facts = json.loads((run / "audit.json").read_text())
    assert facts["run_seal"] == json.loads((run / "manifest.json").read_text())["seal"]
    assert facts["audit"]["r_in_m"] == 5.0
    assert facts["gap_frames"] == 10


def test_a_data_set_with_one_class_gets_recall_and_a_plain_sentence(tmp_path):
    run, truth = judged.seal(tmp_path, always_in=True, n=120)
    done = evaluate(run, truth, judged.config())
    table = read_table(run / "metrics.csv", "metrics")
    assert np.isnan(table["auroc"]).all()
    assert np.isnan(table["far"]).all()
    assert np.isfinite(table["frr"]).all()
    assert (read_table(run / "tables/recall.csv", "recall")["answerable"] > 0).all()
    text = " ".join(done.sentences)
    assert "with one class there is no AUROC" in text
    assert "fallback" in text
    assert not (run / "figures/roc.csv").exists()


def test_a_calibration_split_off_the_map_has_no_threshold_and_accepts_nothing(tmp_path, no_figures):
    run, truth = judged.seal(tmp_path, n=120)
    done = evaluate(run, truth, judged.config(r_in_m=1e-6, r_out_m=1e-5))
    table = read_table(run / "metrics.csv", "metrics")
    answered = np.char.startswith(table["signal"].astype(str), "probability_wrong")
    assert np.isnan(table["threshold"][~answered]).all()
    assert "no threshold" in " ".join(done.sentences)
    # Every answer of the calibration half is wrong: none is like one that was right.
    assert "accept" not in done.judgement.verdicts["verdict"]


@pytest.mark.parametrize("status", ["no_candidates", "warming_up"])
def test_a_run_without_an_answer_abstains_throughout(status, tmp_path, no_figures):
    run, truth = judged.seal(tmp_path, n=120, status=status)
    done = evaluate(run, truth, judged.config())
    for name in ("verdict", "verdict_now"):
        assert set(done.judgement.verdicts[name]) == {"abstain"}
    assert np.isnan(done.judgement.verdicts["x_m"]).all()
    assert done.judgement.errors["n"][0] == 0


def test_a_broken_seal_is_refused_and_nothing_is_written(tmp_path):
    run, truth = judged.seal(tmp_path, n=60)
    raw = bytearray((run / "signals.csv").read_bytes())
    raw[-2] ^= 1
    (run / "signals.csv").write_bytes(bytes(raw))
    with pytest.raises(InputError, match="seal broken"):
        evaluate(run, truth, judged.config())
    assert not (run / "labels.csv").exists()


def test_truth_of_another_recording_is_refused(tmp_path):
    run, truth = judged.seal(tmp_path, n=60)
    file = truth / "query_poses.csv"
    file.write_text("\n".join(file.read_text().splitlines()[:-1]) + "\n")
    with pytest.raises(InputError, match="59 poses for a run of 60 frames"):
        evaluate(run, truth, judged.config())


def test_the_summary_puts_the_scenarios_beside_the_paper(tmp_path, case, no_figures):
    _, _, _, done = case
    (tmp_path / "full").mkdir()
    run, truth = judged.seal(tmp_path / "full", always_in=True, n=120)
    whole = evaluate(run, truth, judged.config())
    words = write_summary(tmp_path / "out", {"full": whole, "default": done, "h3": done})
    out = tmp_path / "out"
    table = read_table(out / "tables/mapout.csv", "mapout")
    assert table["scenario"].tolist() == ["default", "h3"]
    np.testing.assert_array_equal(table["paper_top1_auroc"], [0.937, 0.977])
    np.testing.assert_array_equal(table["paper_tao_far"], [0.259, 0.049])
    head, *rows = (out / "metrics.csv").read_text().splitlines()
    assert head.startswith("scenario,signal,n_in,")
    assert {row.split(",")[0] for row in rows} == {"full", "default", "h3"}
    micro = read_table(out / "tables/micro.csv", "micro")
    assert np.isnan(micro["auroc"][micro["radius_m"] == 5.0]).all()
    assert any("one class" in sentence for sentence in words)
    assert set(json.loads((out / "manifest.json").read_text())["scenarios"]) == {
        "full", "default", "h3",
    }  # fmt: skip
    html = (out / "report.html").read_text()
    assert "h3/report.html" in html
    assert "The world is simulated" in html


def test_markdown_and_latex_hold_every_row(case):
    table = case[3].judgement.recall
    assert to_markdown("recall", table).count("\n") == 2 + 3
    latex = to_latex("recall", table)
    assert latex.count(r"\\") == 1 + 3
    assert r"r\_at\_100" in latex
