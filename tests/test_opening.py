"""What a report opens with: its numbers are those of the files, and hard cases are told plainly."""

import re

import judged
import numpy as np
import pytest

from taojax import cli
from taojax.audit import figures, opening
from taojax.audit.evaluate import evaluate
from taojax.audit.judgement import Evaluation
from taojax.audit.opening import KINDS, draw_opening, kinds_of
from taojax.audit.summary_text import find_words, summary_words, terminal_words
from taojax.files.tables import read_table


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return judged.evaluated(tmp_path_factory.mktemp("case"))


@pytest.fixture
def no_figures(monkeypatch):
    monkeypatch.setattr(figures, "draw", lambda judgement: ())


def refused(folder):
    """Judge a run whose calibration half supports no promise."""
    run, truth = judged.seal(folder)
    return run, evaluate(run, truth, judged.config(max_wrong=0.001))


def counted(run):
    """Count the kinds of test frames from the files alone."""
    verdicts = read_table(run / "verdicts.csv", "verdicts")
    labels = read_table(run / "labels.csv", "labels")
    truth = np.loadtxt(run.parent / "truth/query_poses.csv", delimiter=",", skiprows=1)
    error = np.hypot(verdicts["x_m"] - truth[:, 1], verdicts["y_m"] - truth[:, 2])
    test, near = labels["split"] == "test", labels["nearest_m"] <= 10.0
    accepted, right = test & (verdicts["verdict"] == "accept"), error <= 10.0
    return {
        "wrong": (accepted & ~right).sum(),
        "right": (accepted & right & near).sum(),
        "aside": (accepted & right & ~near).sum(),
        "rejected": (test & (verdicts["verdict"] == "reject")).sum(),
        "abstained": (test & (verdicts["verdict"] == "abstain")).sum(),
    }


def test_the_legend_counts_the_verdicts_against_the_truth(case):
    run, done = case
    legend = {entry.kind: entry for entry in draw_opening(done.judgement).legend}
    want = {kind: n for kind, n in counted(run).items() if n or kind != "aside"}
    assert {kind: entry.frames for kind, entry in legend.items()} == want
    row = opening.accepted_row(done.judgement, "final")
    assert (legend["right"].frames, legend["wrong"].frames) == (row["right"], row["wrong"])
    left = legend["rejected"].n_right + legend["abstained"].n_right
    assert row["right"] + left == row["right_total"]
    html = (run / "report.html").read_text()
    shown = html.split('class="legend"')[1].split("</ul>")[0]
    plain = re.sub(r"<[^>]*>", "", shown)
    for kind, entry in legend.items():
        assert f"{KINDS[kind]}: {want[kind]}" in plain
        if entry.frames:
            assert kinds_of(done.judgement)[entry.first] == kind
            assert done.judgement.splits.name[entry.first] == "test"


def test_the_three_numbers_are_those_of_the_table(case):
    run, done = case
    table = read_table(run / "tables/verdicts.csv", "verdict_table")
    at = list(table["verdict"]).index("final")
    wrong, recall, promised = opening.numbers(done.judgement)
    assert wrong.text == opening.percent(table["wrong_share"][at])
    assert wrong.about.startswith(f"{table['wrong'][at]:.0f} of {table['accepted'][at]:.0f} ")
    assert recall.text == opening.percent(table["recall"][at])
    assert recall.about.startswith(f"{table['right'][at]:.0f} of {table['right_total'][at]:.0f} ")
    assert promised.text == f"at most {opening.percent(table['max_wrong'][at])}"
    html = (run / "report.html").read_text()
    cards = re.findall(r'<div class="card.*?<b>(.*?)</b>', html)
    assert cards == [wrong.text, recall.text, promised.text]


def test_the_page_shows_sentence_picture_and_numbers_and_folds_the_rest(case):
    run, done = case
    html = (run / "report.html").read_text()
    body = html.split("<main>")[1]
    first = body[: body.index("<details")]
    assert opening.sentence(done.judgement) in re.sub(r"<[^>]*>", "", first)
    assert first.count("<figure>") == 1
    assert first.count("<strong>") == 3
    assert "<table" not in first
    folds = re.findall(r'<details class="fold" id="(\w+)"( open)?>', body)
    assert [name for name, _ in folds] == [
        "said", "along", "tables", "figures", "words", "notes", "seal",
    ]  # fmt: skip
    assert not any(is_open for _, is_open in folds)


def test_wrong_acceptances_are_drawn_last_and_tied_to_their_answers(case):
    judgement = case[1].judgement
    kind = np.where(judgement.splits.name == "test", "accepted_wrong", "")
    n = (kind == "accepted_wrong").sum()
    own = judgement.answers.final
    is_wrong = own.is_wrong | (np.arange(240) % 3 == 0)
    answers = judgement.answers._replace(
        final=own._replace(is_right=own.is_right & ~is_wrong, is_wrong=is_wrong)
    )
    drawing = draw_opening(judgement._replace(answers=answers))
    shapes = re.findall(r'class="([\w ]+)"', drawing.svg)
    assert shapes[-2:] == ["tie", "dots wrong"]
    assert shapes.index("dots map") < shapes.index("dots right")
    found = next(entry for entry in drawing.legend if entry.kind == "wrong")
    tie = re.search(r'class="tie"[^>]* d="([^"]*)"', drawing.svg)[1]
    assert 0 < found.frames == tie.count("M") <= n


def test_the_picture_has_y_up_equal_axes_and_a_true_scale_bar(case):
    judgement = case[1].judgement
    drawing = draw_opening(judgement)
    dots = re.search(r'class="dots map" points="([^"]*)"', drawing.svg)[1]
    at = np.array([pair.split(",") for pair in dots.split()], dtype=float)
    assert len(at) == len(judgement.map_m)
    wide = float(re.search(r'viewBox="0 0 (\d+)', drawing.svg)[1])
    per_m = drawing.bar_share * wide / drawing.bar_m
    east_m = judgement.map_m[:, 0] - judgement.map_m[0, 0]
    np.testing.assert_allclose(at[:, 0] - at[0, 0], per_m * east_m, atol=0.11)
    high = judgement._replace(query_m=judgement.query_m + [0.0, 40.0])
    rows = [
        np.array([p.split(",") for p in re.search(
            rf'class="dots {kind}" points="([^"]*)"', draw_opening(high).svg)[1].split()], float)
        for kind in ("map", "right")
    ]  # fmt: skip
    # The page's y grows downwards.
    assert rows[1][:, 1].max() < rows[0][:, 1].min()


def test_a_tall_map_is_no_taller_than_three_quarters_of_its_width(case):
    judgement = case[1].judgement
    turned = judgement._replace(map_m=judgement.map_m[:, ::-1], query_m=judgement.query_m[:, ::-1])
    drawing = draw_opening(turned)
    wide, high = map(float, re.search(r'viewBox="0 0 (\d+) (\d+)"', drawing.svg).groups())
    assert high <= 0.751 * wide
    assert not drawing.is_flat
    assert draw_opening(judgement).is_flat


def test_where_no_promise_can_be_kept_the_page_says_what_was_found_and_what_would_help(
    tmp_path, no_figures
):
    run, done = refused(tmp_path)
    said = opening.sentence(done.judgement)
    assert re.fullmatch(
        r"No closure is accepted on the \d+ test frames, though \d+ answers are right: the "
        r"calibration half supports no promise of at most 0\.1 % wrong\.",
        said,
    )
    assert done.sentences[0] == said
    wrong, recall, promised = opening.numbers(done.judgement)
    assert (wrong.text, recall.text, promised.text) == ("—", "0 %", "nothing")
    assert "right and" in promised.about
    assert "could be kept" in promised.about
    assert "would help" in promised.about
    assert promised.about in (run / "report.html").read_text()


def test_nothing_accepted_though_a_promise_stands_keeps_the_recording_out_of_the_graph(case):
    judgement = case[1].judgement
    none = judgement._replace(
        accepted=judgement.accepted
        | {name: np.zeros(2) for name in ("accepted", "right", "wrong", "recall")}
        | {name: np.full(2, np.nan) for name in ("wrong_share", "wrong_lo", "wrong_hi")}
    )
    assert opening.sentence(none).endswith("no closure of this recording should enter a graph.")
    assert opening.numbers(none)[0].text == "—"
    assert "none of" in opening.numbers(none)[0].about


def test_no_right_answer_in_the_test_half_is_said(case):
    judgement = case[1].judgement
    none = judgement._replace(
        accepted=judgement.accepted
        | {name: np.zeros(2) for name in ("accepted", "right", "wrong", "right_total")}
        | {name: np.full(2, np.nan) for name in ("wrong_share", "recall", "recall_lo")}
    )
    assert "and no answer is right" in opening.sentence(none)
    assert opening.numbers(none)[1][1:3] == ("—", "no test answer is right")


def test_a_recording_without_a_test_half_has_a_page_and_three_dashes(tmp_path, no_figures):
    run, truth = judged.seal(tmp_path, n=12)
    done = evaluate(run, truth, judged.config())
    assert opening.sentence(done.judgement) == opening.TOO_SHORT
    assert [number.text for number in opening.numbers(done.judgement)][:2] == ["—", "—"]
    assert all("no test half" in n.about for n in opening.numbers(done.judgement)[:2])
    assert not any(entry.frames for entry in draw_opening(done.judgement).legend)
    assert f"warning: {opening.TOO_SHORT}" in terminal_words(done)


def test_a_broken_promise_is_said_and_marked(case):
    judgement = case[1].judgement
    table = judgement.accepted | {"wrong_share": np.full(2, 0.2)}
    broken = judgement._replace(accepted=table)
    assert opening.sentence(broken).endswith("and 20 % are.")
    assert opening.numbers(broken)[0].is_broken
    said = opening.summary_sentence({"h3": judgement, "h4": broken})
    assert said.endswith("more than the promised 5 % are wrong in h4.")
    assert "no scenario has more" in opening.summary_sentence({"h3": judgement})


def test_the_terminal_says_the_three_numbers_then_warnings(case, capsys, tmp_path, no_figures):
    run, done = case
    words = ("evaluate", str(run), "--truth", str(run.parent / "truth"), "--r-in", "5")
    assert cli.main([*words, "--r-out", "10", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out.splitlines()
    table = read_table(tmp_path / "tables/verdicts.csv", "verdict_table")
    share, recall = (opening.percent(table[name][1]) for name in ("wrong_share", "recall"))
    assert printed[0].startswith(f"wrong among the accepted: {share} (")
    assert printed[1].startswith(f"of the right ones accepted: {recall} (")
    assert printed[2].startswith("promised: at most 5 % (")
    assert all(line.startswith("warning: ") for line in printed[3:])
    alarmed = Evaluation(run, done.judgement, (), "", warnings=("look out",))
    assert terminal_words(alarmed)[-1] == "warning: look out"
    several = summary_words({"h3": alarmed, "h4": done})
    assert several[1].startswith(f"h3: wrong among the accepted {done_share(done)}, ")
    assert "warning: h3: look out" in several


def done_share(done):
    return opening.numbers(done.judgement)[0].text


def test_the_first_sentence_is_the_first_of_all(case):
    judgement = case[1].judgement
    assert find_words(judgement)[0] == opening.sentence(judgement)
    assert len(set(find_words(judgement))) == len(find_words(judgement))


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (1.0, "100 %"), (0.0004, "< 0.1 %"), (0.99995, "> 99.9 %"), (0.125, "12.5 %"),
     (float("nan"), "—")],
)  # fmt: skip
def test_a_percentage_never_rounds_to_none_or_all(share, text):
    assert opening.percent(share) == text
