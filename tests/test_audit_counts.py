"""Every frame is counted once, and a reader can follow each rate to the frames it counts."""

import re

import judged
import numpy as np
import pytest

from taojax.audit import summary_text
from taojax.audit.summary_text import find_words, metric_row
from taojax.files.tables import read_table


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return judged.evaluated(tmp_path_factory.mktemp("case"))


def rows_of(judgement):
    table = summary_text.counts_table(judgement)
    names = ("in_map", "map_out", "grey", "frames")
    return {
        str(name): dict(zip(names, values, strict=True))
        for name, *values in zip(table["decided"], *(table[n] for n in names), strict=True)
    }


def test_rows_and_columns_add_up_to_all_frames(case):
    judgement = case[1].judgement
    rows = rows_of(judgement)
    assert rows["all frames"]["frames"] == len(judgement.label)
    kinds = list(rows)[: list(rows).index("test split")]
    for column in ("in_map", "map_out", "grey", "frames"):
        assert sum(rows[kind][column] for kind in kinds) == rows["test split"][column]
        splits = ("test split", "calibration split", "gap between the splits")
        assert sum(rows[name][column] for name in splits) == rows["all frames"][column]
    for row in rows.values():
        assert row["in_map"] + row["map_out"] + row["grey"] == row["frames"]
    test = judgement.splits.name == "test"
    accepted = (judgement.verdicts["verdict"] == "accept") & test
    assert rows["accepted"]["frames"] == accepted.sum()
    assert rows["accepted"]["map_out"] == (accepted & (judgement.label == "map_out")).sum()


def test_each_rate_counts_rows_of_the_table(case):
    judgement = case[1].judgement
    rows, rates = rows_of(judgement), summary_text.rates_of(judgement)
    test = judgement.splits.test
    above = judgement.verdicts["probability_map_out"][test.frame] > judgement.detector.threshold
    alone = {
        summary_text.THRESHOLD_FAR: ~above & test.is_out,
        summary_text.THRESHOLD_FRR: above & test.is_in,
    }
    for name, kind, column in (
        (summary_text.VERDICT_FAR, "accepted", "map_out"),
        (summary_text.THRESHOLD_FAR, None, "map_out"),
        (summary_text.LEFT_OUT, "abstained", "map_out"),
        (summary_text.VERDICT_FRR, "rejected", "in_map"),
        (summary_text.THRESHOLD_FRR, None, "in_map"),
        (summary_text.LEFT_IN, "abstained", "in_map"),
    ):
        rate = rates[name]
        assert rate["n"] == (rows[kind][column] if kind else alone[name].sum()), name
        assert rate["n_of"] == rows["test split"][column]
        np.testing.assert_allclose(rate["value"], rate["n"] / rate["n_of"])
        assert rate["value_lo"] <= rate["value"] <= rate["value_hi"]


def test_the_rates_at_the_threshold_are_those_of_metrics_csv(case):
    judgement = case[1].judgement
    row, rates = metric_row(judgement, "fused"), summary_text.rates_of(judgement)
    for name, column in ((summary_text.THRESHOLD_FAR, "far"), (summary_text.THRESHOLD_FRR, "frr")):
        for end in ("", "_lo", "_hi"):
            np.testing.assert_allclose(rates[name][f"value{end}"], row[f"{column}{end}"])


def test_the_sentences_say_the_numbers_of_the_table(case):
    text, rows = " ".join(case[1].sentences), rows_of(case[1].judgement)
    said = re.search(
        r"of (\d+) map-out test frames \(prevalence [\d.]+\) the verdicts accepted (\d+), rejected "
        r"(\d+) and abstained on (\d+)",
        text,
    )
    kinds = ("test split", "accepted", "rejected", "abstained")
    assert [int(number) for number in said.groups()] == [rows[k]["map_out"] for k in kinds]


def test_both_tables_stand_in_the_run_folder_and_can_be_read_again(case):
    run, done = case
    for name in ("counts", "rates"):
        table = read_table(run / f"tables/{name}.csv", name)
        made = getattr(summary_text, f"{name}_table")(done.judgement)
        assert list(table) == list(made)
        assert (run / f"tables/{name}.tex").read_text().count("\\\\") == 1 + len(
            table["frames" if name == "counts" else "rate"]
        )
        for column in made:
            assert not any("," in str(value) for value in made[column])


def test_the_first_sentence_tells_the_accepted_and_the_right_apart(case):
    judgement = case[1].judgement
    own = judgement.answers.at(judgement.splits.test.frame).final
    accepted = (judgement.verdicts["verdict"] == "accept")[judgement.splits.test.frame]
    right, wrong = (int((accepted & kind).sum()) for kind in own)
    first, promised = find_words(judgement)[:2]
    assert right > 0
    assert first.startswith(f"{right} of {right + wrong} accepted answers are right, and ")
    assert f"and {right} of {int(own.is_right.sum())} right answers are accepted" in first
    assert promised == f"Promised: {judgement.calibration.final.promise}."


def test_without_a_threshold_no_rate_pretends(case):
    judgement = case[1].judgement
    n = len(judgement.label)
    blind = judgement._replace(
        detector=judgement.detector._replace(threshold=np.nan),
        verdicts=judgement.verdicts | {"verdict": np.full(n, "abstain", dtype=object)},
    )
    rows = rows_of(blind)
    assert rows["abstained"]["frames"] == rows["test split"]["frames"]
    assert summary_text.THRESHOLD_FAR not in summary_text.rates_of(blind)
    assert any("no threshold" in sentence for sentence in find_words(blind))
