"""Right or wrong: frozen numbers in a file, levels that fail closed, and the judge's own labels."""

import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taojax import risk
from taojax.audit import labels, tables
from taojax.audit import risk as judge
from taojax.audit.risk import Answers, Own
from taojax.config import AuditConfig
from taojax.decisions import decide, judged
from taojax.errors import InputError
from taojax.risk import (
    Calibration,
    Detector,
    MapFacts,
    Risk,
    at_most,
    for_run,
    foreign_map,
    read_calibration,
    shipped,
    to_toml,
)

SEEN = MapFacts("ab12", "ef56", 2.0, 0.9)

NOW = Risk(
    ("now_place", "now_cost"), np.array([-1.0, 0.5]), np.array([3.0, 0.3]), np.array([1.0, 2.0]),
    -0.7, np.array([0.01, 0.05, 0.2]), np.array([np.nan, 0.1, 0.4]), 0.05, "made up",
)  # fmt: skip
FINAL = NOW._replace(columns=("place", "cost"), bias=-1.5)
MAP_OUT = Detector(("cost",), np.zeros(1), np.ones(1), np.ones(1), 0.0, 0.5, "made up too")
WHOLE = Calibration(NOW, FINAL, MAP_OUT, SEEN)


def same(a, b):
    """Compare numbers that may be NaN."""
    assert type(a) is type(b)
    for name in a._fields:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def written(folder, text):
    path = folder / "calibration.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("calibration", [WHOLE, WHOLE._replace(fitted_on=None), shipped()])
def test_a_file_gives_back_every_number(calibration, tmp_path):
    again = read_calibration(written(tmp_path, to_toml(calibration)))
    same(again.now, calibration.now)
    same(again.final, calibration.final)
    same(again.map_out, calibration.map_out)
    assert again.fitted_on == calibration.fitted_on


def test_quotes_in_words_do_not_break_the_file(tmp_path):
    odd = WHOLE._replace(final=FINAL._replace(promise='a "b" \\ c'))
    assert read_calibration(written(tmp_path, to_toml(odd))).final.promise == "a 'b' / c"


OLD = """\
columns = ["tao"]
mean = [0.5]
scale = [1.0]
weight = [1.0]
bias = 0.0
threshold = 0.5
note = "of 0.1.0"
"""


def test_a_file_of_the_first_version_is_told_apart(tmp_path):
    with pytest.raises(InputError, match=r"0\.1\.0.*`taojax audit`") as told:
        read_calibration(written(tmp_path, OLD))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("schema = 3", "schema = 4", "schema 4, this taojax reads 3"),
        ("schema = 3\n", "", "schema"),
        ('"place"', '"plaice"', "unknown column 'plaice'"),
        # Causal numbers must not read what comes after.
        ('"now_place"', '"place"', "unknown column 'place'"),
        ('"place", "cost"', '"place"', "do not fit the columns"),
        ("weight = [1.0, 2.0]", "weight = [1.0, nan]", "do not fit the columns"),
        ("scale = [3.0, 0.3]", "scale = [3.0, 0.0]", "do not fit the columns"),
        ("mean = [-1.0, 0.5]", "mean = [[-1.0, 0.5]]", "do not fit the columns"),
        ("bias = -1.5", "bias = inf", "do not fit the columns"),
        ("bias = -1.5", "bias = x", "not a calibration file"),
        ("levels = [nan, 0.1, 0.4]", "levels = [0.1, 0.4]", "levels and max_wrong do not fit"),
        ("levels = [nan, 0.1, 0.4]", "levels = [nan, 0.1, 1.4]", "levels and max_wrong do not fit"),
        ("max_wrong = 0.05", "max_wrong = 1.0", "levels and max_wrong do not fit"),
        ("[final]", "[finale]", "'final'"),
        ("[map]\n", "[map]\nspacing = 1\n#", "poses_sha256"),
    ],
)
def test_numbers_that_do_not_fit_are_refused_in_one_line(old, new, said, tmp_path):
    text = to_toml(WHOLE)
    assert old in text
    broken = text.replace(old, new) if said != "poses_sha256" else text[: text.index("poses_")]
    with pytest.raises(InputError, match=re.escape(said)) as told:
        read_calibration(written(tmp_path, broken))
    assert "calibration.toml" in str(told.value)
    assert "\n" not in str(told.value)


def test_what_ships_reads_all_there_is_and_has_levels():
    made = shipped()
    assert all(name.startswith("now_") for name in made.now.columns)
    assert tuple(name.removeprefix("now_") for name in made.now.columns) == made.final.columns
    assert made.fitted_on is None
    for numbers in (made.now, made.final):
        assert (np.diff(numbers.max_wrongs) > 0).all()
        assert (np.diff(numbers.levels) > 0).all()
        assert 0 < numbers.level < 1


def test_each_share_has_the_level_of_the_largest_share_below_it():
    assert NOW.level == 0.1
    assert at_most(NOW, 0.05) is NOW
    assert at_most(NOW, 0.2).level == 0.4
    assert at_most(NOW, 0.19).level == 0.1
    assert at_most(NOW, 0.3).level == 0.4
    assert at_most(NOW, 0.1 + 0.1).level == 0.4
    assert "at most 0.19" in at_most(NOW, 0.19).promise


@pytest.mark.parametrize("share", [0.001, 0.01, 0.04])
def test_a_share_without_a_level_accepts_nothing_and_says_so(share):
    numbers = at_most(NOW, share)
    assert np.isnan(numbers.level)
    assert numbers.promise == f"nothing is accepted: no level is on file for {share:g}"


def test_without_hindsight_the_final_answers_are_judged_as_causal_ones():
    made = for_run(WHOLE, 0.2, 0)
    assert made.final.columns == ("place", "cost")
    same(made.final._replace(columns=NOW.columns), made.now)
    waits = for_run(WHOLE, 0.2, 20)
    assert waits.final.bias == FINAL.bias
    assert waits.now.max_wrong == waits.final.max_wrong == 0.2


def test_the_probability_is_the_logistic_of_the_terms_and_each_row_stands_alone(rng):
    table = {"place": rng.normal(0, 30, 40), "cost": rng.random(40)}
    p = risk.probability_wrong(FINAL, table)
    odds = (table["place"] + 1) / 3 + 2 * (table["cost"] - 0.5) / 0.3 - 1.5
    np.testing.assert_allclose(p, 1 / (1 + np.exp(-np.clip(odds, -30, 30))), rtol=1e-12)
    assert ((p > 0) & (p < 1)).all()
    part = risk.probability_wrong(FINAL, {name: values[7:9] for name, values in table.items()})
    np.testing.assert_array_equal(p[7:9], part)


def test_a_lone_answer_is_as_doubtful_as_three_times_what_the_filter_says(tmp_path):
    table = {"place": np.full(4, -9.0), "cost": np.zeros(4), "alone": [0.0, 0.01, 0.2, 0.5]}
    lone = FINAL._replace(alone="alone")
    plain = risk.probability_wrong(FINAL, table)
    want = np.maximum(plain, [0.0, 0.03, 0.6, 1.0])
    np.testing.assert_allclose(risk.probability_wrong(lone, table), want)
    assert lone.reads == ("place", "cost", "alone")
    assert FINAL.reads == ("place", "cost")
    _, reasons, _ = judged(lone._replace(levels=np.full(3, 0.001)), table, np.full(4, "ok"))
    assert reasons[2].endswith("largest doubt: alone")
    path = tmp_path / "calibration.toml"
    path.write_text(to_toml(WHOLE._replace(final=lone)))
    assert read_calibration(path).final.alone == "alone"
    assert read_calibration(path).now.alone == ""
    path.write_text(path.read_text().replace('alone = "alone"', 'alone = "loud"'))
    with pytest.raises(InputError, match="unknown column 'loud'"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("here", "words"),
    [
        (SEEN, None),
        (SEEN._replace(recall=0.895), None),
        (SEEN._replace(views_sha256="7890"), "other descriptors of this map"),
        (MapFacts("cd34", "ef56", 0.5, 0.4), "spacing 2 m and recall 0.90; here spacing 0.5 m and"),
    ],
)
def test_a_calibration_knows_its_map(here, words, tmp_path):
    said = foreign_map(read_calibration(written(tmp_path, to_toml(WHOLE))).fitted_on, here)
    assert said is None if words is None else words in said


def test_a_calibration_that_names_no_map_says_nothing_of_it():
    assert foreign_map(shipped().fitted_on, SEEN) is None


# The two verdicts.


def decided(p_now, p_final, status=None, calibration=WHOLE):
    """Decide on answers of chosen probabilities."""
    n = len(p_now)
    logit = lambda p: np.log(p) - np.log1p(-np.asarray(p))
    # One feature carries the odds, the other stands at its mean.
    signals = {"frame": np.arange(n), "now_cost": np.full(n, 0.5), "tao": np.zeros(n)}
    signals["now_place"] = 3 * (logit(p_now) + 0.7) - 1
    signals["status"] = np.array(status or ["ok"] * n, dtype=object)
    signals |= {"now_x_m": np.arange(n) + 0.5, "now_y_m": np.ones(n), "now_theta_rad": np.zeros(n)}
    delayed = {"frame": np.arange(n), "place": 3 * (logit(p_final) + 1.5) - 1}
    delayed |= {"cost": np.full(n, 0.5), "map_index": np.arange(n)}
    delayed |= {"x_m": np.arange(n) + 0.25, "y_m": np.ones(n), "theta_rad": np.zeros(n)}
    return decide(calibration, signals, delayed)


def test_sure_answers_are_accepted_likely_wrong_ones_rejected_and_the_rest_left_open():
    got = decided([0.3, 0.05, 0.9], [0.05, 0.3, 0.6])
    assert got["verdict"].tolist() == ["accept", "abstain", "reject"]
    assert got["verdict_now"].tolist() == ["abstain", "accept", "reject"]
    np.testing.assert_allclose(got["probability_wrong"], [0.05, 0.3, 0.6], rtol=1e-9)
    np.testing.assert_allclose(got["probability_wrong_now"], [0.3, 0.05, 0.9], rtol=1e-9)
    np.testing.assert_array_equal(got["x_m"], [0.25, 1.25, 2.25])
    np.testing.assert_array_equal(got["x_now_m"], [0.5, 1.5, 2.5])
    np.testing.assert_allclose(got["probability_map_out"], 1 / (1 + np.exp(-0.5)))


def test_the_level_itself_is_accepted_and_a_half_is_not_rejected():
    p = risk.probability_wrong(FINAL, {"place": np.array([0.0]), "cost": np.array([0.5])})[0]
    exact = WHOLE._replace(final=FINAL._replace(levels=np.array([np.nan, p, 0.4])))
    signals = {"frame": np.arange(1), "status": np.array(["ok"], dtype=object), "tao": np.zeros(1)}
    signals |= {"now_place": np.array([3 * 0.7 - 1]), "now_cost": np.array([0.5])}
    signals |= {"now_x_m": np.zeros(1), "now_y_m": np.zeros(1), "now_theta_rad": np.zeros(1)}
    delayed = {"place": np.array([0.0]), "cost": np.array([0.5]), "map_index": np.zeros(1, int)}
    delayed |= {"x_m": np.zeros(1), "y_m": np.zeros(1), "theta_rad": np.zeros(1)}
    got = decide(exact, signals, delayed)
    assert got["verdict"][0] == "accept"
    assert got["probability_wrong_now"][0] == pytest.approx(0.5)
    below = exact._replace(final=FINAL._replace(levels=np.array([np.nan, p * (1 - 1e-9), 0.4])))
    assert decide(below, signals, delayed)["verdict"][0] == "abstain"


def test_reasons_name_the_probability_the_level_and_the_largest_doubt():
    got = decided([0.3, 0.05, 0.9], [0.05, 0.3, 0.9])
    accept, abstain, reject = got["reason"]
    assert accept == "wrong with probability 0.05; accepted up to 0.1"
    assert "neither sure enough to accept (at most 0.1) nor to reject" in abstain
    assert "more likely wrong than right; largest doubt: place" in reject
    assert "largest doubt: now_place" in got["reason_now"][2]
    assert not any("," in reason for name in ("reason", "reason_now") for reason in got[name])


@pytest.mark.parametrize("status", ["warming_up", "no_candidates"])
def test_a_frame_without_an_answer_of_its_own_is_left_open_and_has_no_pose(status):
    got = decided([0.01, 0.01], [0.01, 0.01], [status, "ok"])
    for name in ("verdict", "verdict_now"):
        assert got[name].tolist() == ["abstain", "accept"]
    assert got["reason"][0].startswith(status)
    assert got["map_index"].tolist() == [-1, 1]
    for name in ("x_m", "y_m", "theta_rad", "x_now_m", "y_now_m", "theta_now_rad"):
        assert np.isnan(got[name]).tolist() == [True, False]


@pytest.mark.parametrize("status", ["degenerate"])
def test_a_window_of_tao_that_fails_does_not_silence_the_filter(status):
    got = decided([0.01], [0.01], [status])
    assert (got["verdict"][0], got["verdict_now"][0]) == ("accept", "accept")


def test_without_a_level_nothing_is_accepted_and_what_is_likely_wrong_still_rejected():
    closed = for_run(WHOLE, 0.01, 20)
    got = decided([0.001, 0.9], [0.001, 0.9], calibration=closed)
    assert got["verdict"].tolist() == got["verdict_now"].tolist() == ["abstain", "reject"]
    assert got["reason"][0] == "no level: nothing is accepted: no level is on file for 0.01"


# What the judge makes of the truth.


def test_far_answers_are_wrong_near_ones_right_and_near_ones_off_the_map_neither():
    own = judge.own_answers(
        np.array([0.0, 5.0, 5.1, 1.0, 9.0]), np.array([1.0, 4.0, 1.0, 4.1, 50.0]), 5.0, 4.0
    )
    assert own.is_right.tolist() == [True, True, False, False, False]
    assert own.is_wrong.tolist() == [False, False, True, False, True]


def test_an_answer_that_is_no_number_is_wrong():
    own = judge.own_answers(np.array([np.nan]), np.array([1.0]), 5.0, 4.0)
    assert own.is_wrong.tolist() == [True]


def test_wrong_is_never_nearer_than_twice_what_is_in_the_map():
    assert AuditConfig(r_in_m=5.0, r_out_m=30.0).wrong_m == 30.0
    assert AuditConfig(r_in_m=5.0, r_out_m=6.0).wrong_m == 10.0


def own_of(kind):
    """Return labels from letters: r right, w wrong, - neither."""
    kind = np.array(list(kind))
    return Own(kind == "r", kind == "w")


tied = st.integers(0, 12).map(lambda n: n / 16)
some = st.lists(st.tuples(tied, st.sampled_from("rrrw-")), min_size=1, max_size=80)


@given(some, st.sampled_from([0.01, 0.05, 0.2, 0.5]))
@settings(max_examples=200, deadline=None)
def test_the_checked_level_is_the_highest_that_keeps_the_promise_in_a_harsher_world(rows, most):
    p, own = np.array([row[0] for row in rows]), own_of(row[1] for row in rows)
    want = np.nan
    for level in sorted(set(p)):
        right = sum(own.is_right[i] for i in range(len(p)) if p[i] <= level)
        wrong = sum(own.is_wrong[i] for i in range(len(p)) if p[i] <= level)
        is_kept = judge.HARSHER * wrong <= most * (judge.HARSHER * wrong + right) + 1e-12
        if right >= judge.LEAST_ACCEPTED and is_kept:
            want = level
    if own.is_right.sum() < judge.LEAST_RIGHT:
        return
    got = judge.checked_level(p, own, most)
    # A level is one among what can be told apart: nothing lies between it and the brute force's.
    known = p[own.is_right | own.is_wrong]
    assert np.isnan(got) == np.isnan(want)
    if not np.isnan(want):
        np.testing.assert_array_equal(known <= got, known <= want)


@given(some)
@settings(max_examples=200, deadline=None)
def test_risk_and_coverage_are_those_of_a_plain_count(rows):
    signal, own = np.array([row[0] for row in rows]), own_of(row[1] for row in rows)
    got = judge.risk_row(signal, own)
    known = [(s, not w) for s, w, r in zip(signal, own.is_wrong, own.is_right, strict=True)
             if w or r]  # fmt: skip
    if not known:
        assert got == {}
        return
    known.sort()  # among equals the wrong ones come first: they are taken first
    shares = [sum(not right for _, right in known[: n + 1]) / (n + 1) for n in range(len(known))]
    assert got["aurc"] == pytest.approx(np.mean(shares))
    total = int(own.is_right.sum())
    assert ("recall_at_p95" in got) == (total > 0)
    for name, precision in (("recall_at_p95", 0.95), ("recall_at_p99", 0.99)):
        best = 0.0
        for level in sorted({s for s, _ in known}) if total else ():
            taken = [right for s, right in known if s <= level]
            if sum(taken) >= precision * len(taken) - 1e-12:
                best = max(best, sum(taken) / total)
        assert got.get(name, 0.0) == pytest.approx(best)
    coverage, wrong = judge.risk_coverage(signal, own, steps=10)
    for c, w in zip(coverage, wrong, strict=True):
        n = max(1, int(np.ceil(c * len(known) - 1e-9)))
        assert w == pytest.approx(shares[n - 1])


def test_ties_count_against_a_signal():
    own = own_of("r" * 9 + "w")
    constant = judge.risk_row(np.zeros(10), own)
    assert constant["recall_at_p95"] == 0.0
    assert constant["aurc"] > judge.risk_row(np.r_[np.zeros(9), 1.0], own)["aurc"]
    assert np.isnan(judge.checked_level(np.zeros(30), own_of("r" * 29 + "w"), 0.05))


def test_a_signal_that_is_blank_somewhere_has_no_curve():
    own = own_of("rw")
    assert judge.risk_row(np.array([0.1, np.nan]), own) == {}
    assert judge.risk_coverage(np.array([0.1, np.nan]), own)[0].size == 0
    assert judge.risk_row(np.array([0.1, 0.2]), own_of("--")) == {}


def test_a_separable_signal_gets_every_right_answer_and_an_inverted_one_none():
    own = own_of("r" * 40 + "w" * 60)
    good, bad = judge.risk_row(np.arange(100.0), own), judge.risk_row(-np.arange(100.0), own)
    assert (good["recall_at_p95"], good["recall_at_p99"]) == (1.0, 1.0)
    assert bad["recall_at_p95"] == 0.0
    assert good["aurc"] < 0.3 < 0.6 < bad["aurc"]


def half(kind, *, apart, rng):
    """Return a calibration half whose features tell right from wrong by so much."""
    own = own_of(kind)
    n = len(kind)
    table = {"place": -1 + 3 * apart * np.where(own.is_wrong, 1.0, -1.0) + rng.normal(0, 0.3, n)}
    table["cost"] = rng.normal(0.5, 0.03, n)
    cut = labels.split_frames(
        {name: np.r_[values, values] for name, values in table.items()},
        np.full(2 * n, "in_map"), calibration_share=0.5, gap_frames=0,
    )  # fmt: skip
    return cut.calibration, own


def test_a_half_that_can_be_told_apart_is_accepted_with_confidence(rng):
    split, own = half("r" * 600 + "w" * 100, apart=2.0, rng=rng)
    fitted = judge.refine(FINAL, split, own, 0.05)
    p = risk.probability_wrong(fitted, split.signals)
    assert 0 < fitted.level <= FINAL.level
    assert (p <= fitted.level)[own.is_right].mean() > 0.95
    assert not (p <= fitted.level)[own.is_wrong].any()
    assert fitted.max_wrong == 0.05
    assert "at most 5% of the accepted answers wrong with 90% confidence if blocks of 8 frames" in (
        fitted.promise
    )
    assert "0 of" in fitted.promise
    # What the labels say of one feature goes into its weight; the rest stays near the pooled ones.
    np.testing.assert_allclose(fitted.weight[1], FINAL.weight[1], atol=0.1)


def test_a_half_that_cannot_be_told_apart_accepts_nothing_and_says_what_could_be_kept(rng):
    split, own = half("rw" * 100, apart=0.0, rng=rng)
    fitted = judge.refine(FINAL, split, own, 0.05)
    assert np.isnan(fitted.level)
    assert fitted.promise.startswith("nothing is accepted: in the calibration half (100 right and")
    assert "no --max-wrong could be kept" in fitted.promise
    assert "," not in tables.from_rows("verdict_table", [{"promise": fitted.promise}])["promise"][0]


def test_a_larger_share_is_named_where_only_that_could_be_kept(rng):
    # The most trusted answer is wrong: with 4 for 1 that is 4 in 43 at best, more than 5 %.
    split, own = half("r" * 40 + "w" * 30, apart=2.0, rng=rng)
    own.is_right[0], own.is_wrong[0] = False, True
    split.signals["place"][0] = -20.0
    fitted = judge.refine(FINAL, split, own, 0.05)
    assert np.isnan(fitted.levels).tolist() == [True, True, False]
    assert np.isnan(fitted.level)
    assert "(39 right and 31 wrong answers) even the most trusted" in fitted.promise
    assert "--max-wrong 0.2 could be kept" in fitted.promise


def test_a_half_with_few_right_answers_rests_on_pooled_evidence_alone(rng):
    split, own = half("r" * 12, apart=2.0, rng=rng)
    fitted = judge.refine(FINAL, split, own, 0.05)
    assert fitted.level == FINAL.level
    assert "evidence of pooled recordings alone" in fitted.promise
    assert "20 right answers are needed" in fitted.promise


def test_a_half_of_wrong_answers_that_look_right_accepts_nothing(rng):
    """Useless descriptors must end without an accepted answer, however few are right."""
    split, own = half("w" * 60, apart=-2.0, rng=rng)
    fitted = judge.refine(FINAL, split, own, 0.05)
    p = risk.probability_wrong(fitted, split.signals)
    assert not (p <= fitted.level).any()


def test_a_short_half_is_measured_and_not_proven(rng):
    split, own = half("r" * 60 + "w" * 10, apart=2.0, rng=rng)
    fitted = judge.refine(FINAL, split, own, 0.05)
    assert re.search(r"as measured on (\d+) and not proven: 0 of \1 accepted", fitted.promise)
    assert "360 accepted answers without a wrong one would prove it" in fitted.promise


def test_refining_raises_no_level_that_accepts_nearly_all(rng):
    split, own = half("r" * 200 + "w" * 20, apart=3.0, rng=rng)
    fitted = judge.refine(FINAL, split, own, 0.05)
    for mine, pooled in zip(fitted.levels, FINAL.levels, strict=True):
        assert np.isnan(mine) or mine <= pooled
    assert np.isnan(fitted.levels[0])


def raised(right, wrong):
    """Return the level of a half with these probabilities, over the pooled one."""
    numbers = NOW._replace(weight=np.array([1.0, 0.0]), bias=0.0)
    p = np.r_[right, wrong]
    is_wrong = np.arange(len(p)) >= len(right)
    z = np.stack([np.log(p / (1.0 - p)), np.zeros(len(p))], axis=1)
    split, own = fitted_on(z, is_wrong)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judge, "moved", lambda numbers, z, is_wrong: numbers)
        return judge.refine(numbers, split, own, 0.05).level / NOW.level


def test_a_half_with_enough_trusted_answers_raises_the_level_until_enough_are_accepted():
    trusted = np.linspace(0.01, 0.99 * NOW.level, 31)
    doubted = np.linspace(1.1, 1.6, 9) * NOW.level
    # 95 in a hundred of 40 are 38, the seventh of the doubted.
    assert raised(np.r_[trusted, doubted], [0.9]) == pytest.approx(1.475)
    # At most 5/3 as high, however many are doubted.
    assert raised(np.r_[trusted, doubted, np.full(40, 0.45)], [0.9]) == pytest.approx(5 / 3)
    # A wrong answer in between: four times 1 in 34 + 4 is more than .05.
    assert raised(np.r_[trusted, doubted], [1.25 * NOW.level]) == pytest.approx(1.225)


def test_the_pooled_level_stands_where_a_half_has_nothing_to_gain_or_too_little_to_show():
    doubted = np.linspace(1.1, 1.6, 5) * NOW.level
    # 95 of 100 are accepted as it is.
    assert raised(np.r_[np.linspace(0.01, 0.99 * NOW.level, 95), doubted], [0.9]) == 1.0
    few = np.linspace(0.01, 0.99 * NOW.level, 19)
    assert raised(np.r_[few, doubted], [0.9]) == 1.0
    assert raised(np.r_[few, [0.05], doubted], [0.9]) > 1.0


def test_what_is_more_likely_wrong_than_right_is_never_accepted():
    own = own_of("r" * 100)
    p = np.linspace(0.2, 0.8, 100)
    assert judge.highest_level(p, own, 0.4) == 0.5
    assert judge.highest_level(p, own, 0.3) == 0.3
    assert np.isnan(judge.highest_level(p, own, np.nan))


# tables/verdicts.csv.


def test_the_table_of_verdicts_counts_by_hand():
    verdict = np.array(["accept"] * 6 + ["reject", "abstain"] + ["accept"] * 4, dtype=object)
    now = np.full(12, "abstain", dtype=object)
    now[4] = "accept"
    frames = np.arange(2, 10)
    final = own_of("rrw-rwrr")
    causal = own_of("rrrrrrrr")
    made = tables.verdict_table(
        {"verdict": verdict, "verdict_now": now}, Answers(causal, final), frames,
        {"now": NOW, "final": FINAL._replace(promise="kept, as far as known")},
        AuditConfig(n_bootstrap=200, block_frames=2), 0,
    )  # fmt: skip
    cells = zip(*made.values(), strict=True)
    rows = {str(row[0]): dict(zip(made, row, strict=True)) for row in cells}
    # Frames 2 to 5, 8 and 9 are accepted finally: right, right, wrong, neither, right, right.
    want = {"accepted": 5, "right": 4, "wrong": 1, "right_total": 5, "max_wrong": 0.05}
    for name, value in want.items():
        assert rows["final"][name] == value, name
    assert rows["final"]["wrong_share"] == pytest.approx(0.2)
    assert rows["final"]["recall"] == pytest.approx(0.8)
    for share in ("wrong", "recall"):
        low, high = rows["final"][f"{share}_lo"], rows["final"][f"{share}_hi"]
        assert 0 <= low <= rows["final"]["wrong_share" if share == "wrong" else share] <= high <= 1
    assert (rows["now"]["accepted"], rows["now"]["right"], rows["now"]["wrong"]) == (1, 1, 0)
    assert rows["now"]["recall"] == pytest.approx(1 / 8)
    assert rows["now"]["promise"] == "made up"


def test_without_an_accepted_answer_the_wrong_share_is_blank():
    made = tables.verdict_table(
        {"verdict": np.full(4, "abstain"), "verdict_now": np.full(4, "reject")},
        Answers(own_of("rrww"), own_of("wwww")), np.arange(4), {"now": NOW, "final": FINAL},
        AuditConfig(n_bootstrap=20, block_frames=2), 0,
    )  # fmt: skip
    assert made["accepted"].tolist() == [0, 0]
    assert np.isnan(np.array(made["wrong_share"], float)).all()
    assert float(made["recall"][0]) == 0.0
    assert np.isnan(float(made["recall"][1]))


def test_risk_coverage_is_told_of_every_signal_by_its_own_answers():
    answers = Answers(own_of("rrww"), own_of("wwrr"))
    signal = np.array([0.1, 0.2, 0.3, 0.4])
    made = tables.risk_coverage_table(
        {judge.NOW: signal, judge.FINAL: signal, "tao": -signal}, answers,
        (judge.NOW, judge.FINAL, "tao"),
    )  # fmt: skip
    share = {name: np.array(made["wrong_share"], float)[made["signal"] == name]
             for name in (judge.NOW, judge.FINAL, "tao")}  # fmt: skip
    assert all(len(values) == 100 for values in share.values())
    assert share[judge.NOW][[0, 49, 99]].tolist() == [0.0, 0.0, 0.5]
    assert share[judge.FINAL][[0, 49, 99]].tolist() == [1.0, 1.0, 0.5]
    assert share["tao"][[0, 49, 99]].tolist() == [0.0, 0.0, 0.5]


def test_refined_weights_go_half_of_the_way_to_a_fit_of_stated_precision(rng):
    """The fit in plain NumPy: its gradient is zero where a weight is above zero, else not below."""
    z, is_wrong = rng.normal(size=(160, 2)), rng.random(160) < 0.4
    z[:, 1] += 1.5 * is_wrong
    split, own = fitted_on(z, is_wrong)
    got = judge.refine(NOW, split, own, 0.05)
    start = np.append(NOW.weight, NOW.bias)
    fitted = start + 2.0 * (np.append(got.weight, got.bias) - start)
    n = np.array([(~is_wrong).sum(), is_wrong.sum()])
    counts = (np.minimum(40.0, n / 8.0) / n)[is_wrong.astype(int)]
    gap = counts * (1.0 / (1.0 + np.exp(-(z @ fitted[:2] + fitted[2]))) - is_wrong)
    pull = np.array([10.0, 10.0, 0.05]) * (fitted - start)
    slope = np.append(gap @ z, gap.sum()) + pull
    assert (fitted[:2] > 0).all()
    np.testing.assert_allclose(slope, 0.0, atol=1e-3)
    assert np.abs(pull).max() > 0.1


def fitted_on(z, is_wrong):
    """Return a calibration half whose standardised features are z, and its labels."""
    raw = {name: NOW.mean[k] + NOW.scale[k] * z[:, k] for k, name in enumerate(NOW.columns)}
    twice = {name: np.r_[values, values] for name, values in raw.items()}
    label = np.full(2 * len(z), "in_map")
    cut = labels.split_frames(twice, label, calibration_share=0.5, gap_frames=0)
    return cut.calibration, Own(~is_wrong, is_wrong)


def test_any_signal_is_judged_under_the_rule_of_the_verdicts():
    rank = np.arange(100.0)
    # Of the most trusted 60 answers none is wrong; one in two of the others.
    own = Own((rank < 60) | (rank % 2 == 0), (rank >= 60) & (rank % 2 == 1))
    row = judge.level_row(1e5 * rank, own, 1e5 * rank + 0.5, own, 0.05)
    # 61 is wrong, and four times 1 in 61 + 4 is more than .05.
    assert row["risk_level"] == 60e5
    assert row["risk_recall"] == 60 / 80
    assert row["risk_wrong"] == 0.0
    loose = judge.level_row(rank, own, rank, own, 0.2)
    assert loose["risk_level"] > 60
    assert 0.0 < loose["risk_wrong"] < 0.2
    never = Own(np.zeros(100, bool), np.ones(100, bool))
    assert judge.level_row(rank, never, rank, own, 0.05) == {"risk_recall": 0.0}
    blank = np.full(100, np.nan)
    assert judge.level_row(blank, own, rank, own, 0.05) == {}
    assert judge.level_row(rank, own, blank, own, 0.05) == {}


@pytest.mark.filterwarnings("ignore:All provided predict_params", "ignore:No predict parameters")
@pytest.mark.parametrize("factor", [0.1, 0.5, 1.0, 2.0])
def test_what_mapie_proves_is_promised_with_confidence(factor, rng, monkeypatch):
    """With frames that are exchangeable one by one, its bound is the wider of the two."""
    mapie = pytest.importorskip("mapie.risk_control")
    monkeypatch.setattr(judge, "CORRELATED_FRAMES", 1.0)
    level, n, proved, promised = 0.12, 600, 0, 0
    for _ in range(20):
        p = rng.random(n) ** 3
        is_wrong = rng.random(n) < np.minimum(1.0, factor * p)
        both = np.stack([p, 1.0 - p], axis=1)
        control = mapie.BinaryClassificationController(
            lambda rows: rows, risk="precision", target_level=0.95, confidence_level=0.9,
            list_predict_params=np.array([1.0 - level]),
        )  # fmt: skip
        control.calibrate(both, (~is_wrong).astype(int))
        risk_ = FINAL._replace(levels=np.full(3, level), max_wrong=0.05)
        said = judge.promise_words(risk_, p, Own(~is_wrong, is_wrong))
        does = len(control.valid_predict_params) > 0
        is_promised = "with 90% confidence if blocks of 1 frames are exchangeable" in said
        proved, promised = proved + does, promised + is_promised
        assert is_promised or not does
    # An easy world is proved by both, a hopeless one by neither.
    assert (proved, promised) == {0.1: (20, 20), 2.0: (0, 0)}.get(factor, (proved, promised))


def test_the_name_of_a_calibration_is_none():
    # In an interpreter of its own: here every argument's type is checked at the call.
    code = "import taojax.risk as risk; risk.for_run('calibration.toml', 0.05, 20)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    said = "InputError: calibration: expected what read_calibration returns, got str"
    assert done.stderr.splitlines()[-1].endswith(said)


def test_where_nothing_is_right_the_promise_asks_for_the_order_of_rows_and_offers_no_level():
    risk_ = FINAL._replace(levels=np.array([0.1, np.nan, np.nan]), max_wrong=0.05)
    wrong = np.ones(40, bool)
    said = judge.promise_words(risk_, np.linspace(0, 1, 40), Own(~wrong, wrong))
    assert said.startswith("nothing is accepted: in the calibration half (0 right and 40 wrong")
    assert "do the rows of the descriptors follow" in said
    assert "--max-wrong" not in said
