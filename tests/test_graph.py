"""Pose graphs whose truth is known: back-ends, consistency, odometry noise, and the command."""

import importlib.util
import itertools
import json
import shutil

import numpy as np
import pytest
from conftest import loop, motions, write_folder

from taojax.audit import graph as judge
from taojax.cli import main
from taojax.config import AuditConfig
from taojax.files import pose_graph_io, records
from taojax.files.pose_graph_io import compose, wrap
from taojax.files.tables import read_table
from taojax.graph import answers, methods, odometry
from taojax.graph.answers import Answers, Closure, Run2D, Stream
from taojax.graph.consistency import consistent, exact_clique, greedy_clique
from taojax.graph.odometry import FEW, Chain, Noise

HAS_GTSAM = importlib.util.find_spec("gtsam") is not None
needs_gtsam = pytest.mark.skipif(
    not HAS_GTSAM, reason="GTSAM is not installed: python -m pip install 'taojax[graph]'"
)

FLAGS = ["--window", "6", "--branches", "5", "--association", "rank", "--no-progress"]
"""Rank compiles in a fraction of the time; what is tested does not depend on it."""
SPACING_M = 2.0
AREA_M2 = 1e4
TIGHT = np.diag([0.5, 0.5, 0.05]) ** 2
PLACE = np.diag([0.5**2, 0.5**2, np.inf])
"""A position without a heading."""

NOISE = Noise(0.05, 0.01, "made up")


def drive(rng, n=120, noise=NOISE):
    """Return true poses of a loop and a chain of odometry with a known random walk."""
    truth = loop(n)
    clean = motions(truth)
    way = odometry.steps_m(clean, SPACING_M) / SPACING_M
    sigma = np.array([noise.share * SPACING_M, noise.share * SPACING_M, noise.angle_rad])
    noisy = clean + rng.normal(size=(n, 3)) * sigma * np.sqrt(way)[:, None]
    is_start = np.arange(n) == 0
    way_m = odometry.steps_m(noisy, SPACING_M)
    return truth, Chain(0, noisy, is_start, way_m, SPACING_M, noise)


def right(truth, frames, rng, covariance=TIGHT):
    """Return closures that scatter as their covariance says."""
    sigma = np.sqrt(np.where(np.isfinite(np.diag(covariance)), np.diag(covariance), 0.0))
    return [Closure(t, truth[t] + rng.normal(size=3) * sigma, covariance, 0.05) for t in frames]


def wrong(truth, frames, rng, covariance=TIGHT, p=0.9):
    """Return closures somewhere else on the map."""
    far = [truth[(t + int(rng.integers(30, 90))) % len(truth)] for t in frames]
    return [Closure(t, pose, covariance, p) for t, pose in zip(frames, far, strict=True)]


def solved(chain, closures, back_end, anchor=None):
    from taojax.graph.optimise import solve

    anchor = np.zeros((int(chain.is_start.sum()), 3)) if anchor is None else anchor
    return solve(chain, sorted(closures), back_end, anchor, AREA_M2)


def rmse(solution, truth):
    return float(np.sqrt(np.mean(np.sum((solution.pose[:, :2] - truth[:, :2]) ** 2, axis=1))))


# Back-ends


@needs_gtsam
def test_right_closures_bring_the_trajectory_back(rng):
    truth, chain = drive(rng)
    found = solved(chain, right(truth, range(0, 120, 10), rng), "plain")
    assert rmse(found, truth) < 0.6
    assert np.abs(wrap(found.pose[:, 2] - truth[:, 2])).max() < 0.1
    assert found.weight.tolist() == [1.0] * 12


@needs_gtsam
def test_positions_without_headings_do_too(rng):
    truth, chain = drive(rng)
    found = solved(chain, right(truth, range(0, 120, 10), rng, PLACE), "plain")
    assert rmse(found, truth) < 0.8


@needs_gtsam
def test_a_heading_that_was_not_answered_pulls_at_nothing(rng):
    truth, chain = drive(rng)
    closures = right(truth, range(0, 120, 10), rng, PLACE)
    turned = [c._replace(pose=c.pose + [0.0, 0.0, 2.5]) for c in closures]
    a, b = (solved(chain, part, "plain") for part in (closures, turned))
    np.testing.assert_allclose(a.pose, b.pose, atol=1e-6)


@needs_gtsam
@pytest.mark.parametrize("back_end", ["gnc", "geman_mcclure"])
def test_robust_back_ends_survive_closures_that_break_least_squares(back_end, rng):
    truth, chain = drive(rng)
    good = right(truth, range(0, 120, 4), rng)
    bad = wrong(truth, range(2, 120, 12), rng)
    plain, robust = (solved(chain, good + bad, kind) for kind in ("plain", back_end))
    assert rmse(plain, truth) > 3.0
    assert rmse(robust, truth) < 0.6


@needs_gtsam
def test_gnc_switches_off_the_wrong_closures_and_keeps_the_right_ones(rng):
    truth, chain = drive(rng)
    good, bad = right(truth, range(0, 120, 4), rng), wrong(truth, range(2, 120, 12), rng)
    weight = solved(chain, good + bad, "gnc").weight
    is_bad = np.array([c.frame % 4 == 2 for c in sorted(good + bad)])
    assert weight[is_bad].max() < 0.1
    assert (weight[~is_bad] > 0.9).mean() > 0.9


@needs_gtsam
def test_huber_is_pulled_less_than_least_squares(rng):
    truth, chain = drive(rng)
    closures = right(truth, range(0, 120, 4), rng) + wrong(truth, range(2, 120, 12), rng)
    plain, huber = (solved(chain, closures, kind) for kind in ("plain", "huber"))
    assert rmse(huber, truth) < 0.5 * rmse(plain, truth)


@needs_gtsam
def test_a_switch_believes_the_probability_where_the_graph_cannot_tell(rng):
    truth, chain = drive(rng)
    here, there = truth[:60].copy(), truth[60:].copy()
    rows = range(0, 60, 10)
    good = [Closure(t, here[t], TIGHT, 0.02) for t in rows]
    # As many closures that agree with one another on another place.
    shift = there[0] - here[0]
    bad = [Closure(t + 5, here[t + 5] + [*shift[:2], 0.0], TIGHT, 0.98) for t in rows]
    half = chain._replace(
        odometry=chain.odometry[:60], is_start=chain.is_start[:60], way_m=chain.way_m[:60]
    )
    found = solved(half, good + bad, "switch")
    is_bad = np.array([c.probability_wrong > 0.5 for c in sorted(good + bad)])
    assert found.weight[is_bad].max() < 0.05
    assert found.weight[~is_bad].min() > 0.9
    assert rmse(found, here) < 0.6


@needs_gtsam
def test_a_covariance_holds_in_the_axes_of_the_map():
    """One pose, two closures: the result is the weighted mean that both covariances give."""
    odometry_of_one = np.zeros((1, 3))
    chain = Chain(0, odometry_of_one, np.ones(1, bool), np.ones(1), SPACING_M, NOISE)
    a = np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.01]])
    b = np.array([[1.0, -0.5, 0.0], [-0.5, 9.0, 0.0], [0.0, 0.0, 0.01]])
    heading = 0.8
    closures = [
        Closure(0, np.array([0.0, 0.0, heading]), a, 0.0),
        Closure(0, np.array([1.0, 2.0, heading]), b, 0.0),
    ]
    found = solve_unsorted(chain, closures)
    ia, ib = np.linalg.inv(a[:2, :2]), np.linalg.inv(b[:2, :2])
    want = np.linalg.solve(ia + ib, ib @ [1.0, 2.0])
    np.testing.assert_allclose(found.pose[0, :2], want, atol=0.02)


def solve_unsorted(chain, closures):
    from taojax.graph.optimise import solve

    return solve(chain, closures, "plain", np.zeros((1, 3)), AREA_M2)


@needs_gtsam
def test_stretches_that_odometry_does_not_join_are_solved_side_by_side(rng):
    truth, chain = drive(rng)
    two = chain._replace(is_start=np.isin(np.arange(120), (0, 60)))
    anchor = np.stack([np.zeros(3), truth[60]])
    found = solved(two, right(truth, range(0, 60, 5), rng), "plain", anchor)
    assert rmse(found._replace(pose=found.pose[:60]), truth[:60]) < 0.6
    # The other has no closure: odometry from its anchor.
    np.testing.assert_allclose(found.pose[60], truth[60], atol=1e-6)
    step = compose(found.pose[60], chain.odometry[61])
    np.testing.assert_allclose(found.pose[61], step, atol=1e-5)


# Consistency


def test_greedy_and_exact_pcm_pick_the_consistent_closures(rng):
    truth, chain = drive(rng)
    good, bad = right(truth, range(0, 120, 4), rng), wrong(truth, range(2, 120, 4), rng)
    closures = sorted(good + bad)
    agree = consistent(chain, closures)
    assert (agree == agree.T).all()
    assert not np.diag(agree).any()
    for clique in (greedy_clique(agree), exact_clique(agree, 10.0)):
        frames = {closures[row].frame for row in clique.rows}
        assert not frames & {c.frame for c in bad}
        assert len(frames & {c.frame for c in good}) >= 27
        assert all(agree[a, b] for a, b in itertools.combinations(clique.rows, 2))


def test_places_met_in_the_other_direction_are_consistent_where_no_heading_was_answered(rng):
    truth, chain = drive(rng)
    closures = right(truth, range(0, 120, 10), rng, PLACE)
    turned = [c._replace(pose=c.pose + [0.0, 0.0, np.pi * (c.frame % 20 == 0)]) for c in closures]
    assert len(exact_clique(consistent(chain, turned), 5.0).rows) >= 11
    with_heading = [c._replace(covariance=TIGHT) for c in turned]
    assert len(exact_clique(consistent(chain, with_heading), 5.0).rows) <= 7


def brute_force(agree):
    n = len(agree)
    for size in range(n, 0, -1):
        for rows in itertools.combinations(range(n), size):
            if all(agree[a, b] for a, b in itertools.combinations(rows, 2)):
                return size
    return 0


@pytest.mark.parametrize("density", [0.2, 0.5, 0.8])
def test_the_exact_clique_is_as_large_as_brute_force_finds(density, rng):
    for _ in range(8):
        agree = np.triu(rng.random((11, 11)) < density, 1)
        agree |= agree.T
        found = exact_clique(agree, 10.0)
        assert found.is_largest
        assert all(agree[a, b] for a, b in itertools.combinations(found.rows, 2))
        assert len(found.rows) == brute_force(agree) >= len(greedy_clique(agree).rows)


def test_a_search_that_runs_out_of_time_says_so_and_returns_the_greedy_set(rng):
    agree = np.triu(rng.random((150, 150)) < 0.9, 1)
    agree |= agree.T
    found = exact_clique(agree, 0.0)
    assert not found.is_largest
    assert len(found.rows) == len(greedy_clique(agree).rows) > 10


def test_no_closure_is_no_clique():
    nothing = np.zeros((0, 0), bool)
    assert greedy_clique(nothing).rows == exact_clique(nothing, 1.0).rows == []


# Odometry


def test_the_covariance_of_a_stretch_is_that_of_many_noisy_drives(rng):
    clean = motions(loop(40))
    way = odometry.steps_m(clean, SPACING_M)
    noise = Noise(0.05, 0.004, "made up")
    is_start = np.arange(40) == 0
    chain = Chain(0, clean, is_start, way, SPACING_M, noise)
    sigma = np.sqrt(chain.variances())[:, [0, 0, 1]]
    ends = np.array([
        odometry.dead_reckoning(clean + rng.normal(size=(40, 3)) * sigma, is_start)[[10, 35]]
        for _ in range(700)
    ])  # fmt: skip
    path = odometry.dead_reckoning(clean, is_start)
    # Seen from row 10, in the axes of the noiseless path.
    moved = np.array([compose(path[10], _between(a, b)) for a, b in ends])
    want = np.cov((moved - path[35]).T)
    spacings, turn = odometry.spread(odometry.walk(chain), np.array([10]), np.array([35]))
    got = noise.angle_rad**2 * turn[0]
    got[[0, 1], [0, 1]] += (noise.share * SPACING_M) ** 2 * spacings[0]
    np.testing.assert_allclose(np.sqrt(np.diag(got)), np.sqrt(np.diag(want)), rtol=0.1)
    sigma = np.sqrt(np.diag(want))
    assert (np.abs(got - want) < 0.15 * np.outer(sigma, sigma)).all()


def _between(a, b):
    from taojax.files.pose_graph_io import between

    return between(a, b)


def long_drive(rng, noise, n=600):
    """Five times around the loop."""
    truth, _ = drive(rng, 120)
    truth = np.tile(truth, (n // 120, 1))
    clean = motions(truth)
    way = odometry.steps_m(clean, SPACING_M) / SPACING_M
    sigma = np.array([noise.share * SPACING_M] * 2 + [noise.angle_rad])
    noisy = clean + rng.normal(size=(n, 3)) * sigma * np.sqrt(way)[:, None]
    is_start = np.arange(n) == 0
    return truth, Chain(0, noisy, is_start, odometry.steps_m(noisy, SPACING_M), SPACING_M, FEW)


@pytest.mark.parametrize("angle_rad", [0.005, 0.02])
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_the_noise_of_odometry_is_found_within_a_factor_of_two_and_a_half(share, angle_rad, rng):
    truth, chain = long_drive(rng, Noise(share, angle_rad, ""))
    # Closures better than they claim, and a few wrong ones.
    claim = 9.0 * TIGHT
    closures = right(truth, range(0, 600, 2), rng)
    closures = [c._replace(covariance=claim) for c in closures]
    for t in range(40, 300, 60):
        closures[t] = closures[t]._replace(pose=truth[(2 * t + 50) % 600])
    found = odometry.estimate(chain, closures, 10, AREA_M2)
    assert "accepted closures" in found.why
    assert share / 2.5 <= found.share <= share * 2.5
    assert angle_rad / 2.5 <= found.angle_rad <= angle_rad * 2.5


def test_few_closures_leave_the_stated_default(rng):
    truth, chain = long_drive(rng, NOISE)
    assert odometry.estimate(chain, right(truth, range(0, 60, 2), rng), 10, AREA_M2) == FEW
    assert odometry.estimate(chain, [], 10, AREA_M2) == FEW
    assert "few closures" in FEW.said(SPACING_M)


def test_closures_that_contradict_odometry_leave_the_default_and_say_so(rng):
    truth, chain = long_drive(rng, NOISE)
    found = odometry.estimate(chain, wrong(truth, range(0, 600, 2), rng), 10, AREA_M2)
    assert found[:2] == FEW[:2]
    assert "do not agree" in found.why


def test_noise_grows_with_the_way_and_not_with_the_number_of_frames():
    coarse = np.tile([1.0, 0.0, 0.1], (10, 1))
    fine = np.tile([0.2, 0.0, 0.02], (50, 1))
    sums = [
        Chain(0, m, np.arange(len(m)) == 0, odometry.steps_m(m, SPACING_M), SPACING_M, NOISE)
        .variances()
        .sum(axis=0)
        for m in (coarse, fine)
    ]
    np.testing.assert_allclose(*sums)


# Methods


def made_up(rng, n=240, accepted=None):
    """Return a run of two laps: answers right with a tenth wrong, and where the truth is."""
    truth, chain = long_drive(rng, NOISE, n)
    is_wrong = np.arange(n) % 10 == 5
    pose = truth + rng.normal(size=(n, 3)) * [0.5, 0.5, 0.05]
    pose[is_wrong] = truth[(np.flatnonzero(is_wrong) + 55) % 120]
    every = np.ones(n, bool) if accepted is None else accepted
    cov = np.broadcast_to(TIGHT, (n, 3, 3))
    p = np.where(is_wrong, 0.9, 0.02)
    final = Stream(every & ~is_wrong, pose, cov, p)
    now = Stream(every, pose, cov, p)
    top1 = Stream(np.ones(n, bool), pose, np.broadcast_to(PLACE, (n, 3, 3)), np.full(n, 0.5))
    similarity = np.where(is_wrong, 0.2, 0.8)
    run = Run2D(
        Answers(final, now, top1, similarity), chain.odometry, chain.is_start, loop(120), SPACING_M
    )
    return run, truth


def test_closures_carry_pose_covariance_and_probability_of_chosen_frames_alone(rng):
    run, _ = made_up(rng)
    stream = run.answers.final
    stream.pose[7] = np.nan
    found = stream.closures(stream.accepted & (np.arange(240) < 10))
    assert [c.frame for c in found] == [0, 1, 2, 3, 4, 6, 8, 9]
    np.testing.assert_array_equal(found[2].pose, stream.pose[2])
    np.testing.assert_array_equal(found[2].covariance, TIGHT)
    assert found[2].probability_wrong == 0.02


@needs_gtsam
def test_every_method_is_judged_on_the_test_half_alone(rng):
    run, truth = made_up(rng)
    judged = judge.judge_graph(run, truth[:, :2], AuditConfig(r_in_m=3.0, r_out_m=3.0), 10)
    assert list(judged.table["method"]) == list(judge.TITLES)
    assert judged.frames == (130, 239)
    rows = {o.method: o for o in judged.outcomes}
    assert all(c.frame >= 130 for o in judged.outcomes for c in o.closures)
    assert len(rows["ours"].closures) == 99
    assert len(rows["top1_huber"].closures) == len(rows["ours_switch"].closures) == 110
    assert len(rows["gate_gnc"].closures) == 99
    table = {name: judge._of(judged, name) for name in judge.TITLES}
    assert table["ours"]["wrong_share"] == table["oracle"]["wrong_share"] == 0.0
    assert table["top1_huber"]["wrong_share"] == pytest.approx(0.1)
    assert table["ours"]["off_share"] == 0.0
    assert table["ours"]["rmse_m"] < 1.0
    assert table["ours_now"]["rmse_m"] > 2.0 * table["ours"]["rmse_m"]
    assert table["ours_gnc"]["rmse_m"] < 1.2 * table["oracle"]["rmse_m"] + 0.1
    assert "stays whole" in judge.sentences(judged)[0]


@needs_gtsam
@pytest.mark.parametrize("where", ["in the calibration half", "nowhere"])
def test_without_closures_the_graph_is_odometry_alone_and_says_from_where(where, rng):
    accepted = np.arange(240) < (100 if where == "in the calibration half" else 0)
    run, truth = made_up(rng, accepted=accepted)
    problem = methods.build(run, calibration_end=120, first=130, window=10)
    found = methods.optimise(problem, "ours", [], "plain")
    assert found.note.startswith("no closure: odometry alone")
    final = run.answers.final
    if where == "nowhere":
        frame = 130 + int(np.argmin(final.probability_wrong[130:]))
        assert f"least doubtful answer, of frame {frame}" in found.note
    else:
        frame = 99
        assert "last closure accepted before it, of frame 99" in found.note
    path = odometry.dead_reckoning(run.odometry, run.is_start)
    leads = compose(final.pose[frame], _between(path[frame], path[130:]))
    np.testing.assert_allclose(found.solution.pose[:, :2], leads[:, :2], atol=1e-6)
    judged = judge.judge_graph(run, truth[:, :2], AuditConfig(r_in_m=3.0, r_out_m=3.0), 10)
    assert "odometry alone" in judge.sentences(judged)[0]
    assert np.isnan(judged.table["wrong_share"][list(judged.table["method"]).index("ours")])


@needs_gtsam
def test_the_truth_of_the_test_half_moves_no_trajectory_but_the_oracles(rng):
    run, truth = made_up(rng)
    audit = AuditConfig(r_in_m=3.0, r_out_m=3.0)
    other = truth[:, :2].copy()
    other[130:] = other[130:][::-1] + 100.0
    a, b = (judge.judge_graph(run, t, audit, 10) for t in (truth[:, :2], other))
    for one, two in zip(a.outcomes, b.outcomes, strict=True):
        same = np.array_equal(one.solution.pose, two.solution.pose)
        assert same == (one.method != judge.ORACLE)


@needs_gtsam
@pytest.mark.parametrize(
    ("ours", "every", "best", "words"),
    [
        ((99, 0.0, 1.0, 0.0), (0.8, 44.0), (0.0, 0.9), ("stays whole: 1 m", "GNC it breaks: 44 m")),
        ((99, 0.1, 50.0, 0.7), (0.0, 1.0), (0.0, 0.9),
         ("these closures the graph breaks", "it stays whole", "which is better here")),
        ((9, 0.0, 20.0, 0.6), (0.8, 44.0), (0.0, 0.9), ("None of these closures is wrong",)),
        ((9, 0.0, 5.0, 0.3), (0.32, 6.0), (0.3, 5.0), ("as whole as the right ones alone", "kept")),
        ((9, 0.0, 30.0, 0.8), (0.9, 44.0), (0.8, 30.0), ("do not hold the graph, nor do",)),
        ((0, np.nan, 30.0, 0.8), (0.9, 44.0), (0.0, 1.0), ("The graph is odometry alone (",)),
    ],
)  # fmt: skip
def test_the_one_sentence_is_honest(ours, every, best, words, rng):
    run, truth = made_up(rng, accepted=np.arange(240) < (0 if ours[0] == 0 else 240))
    judged = judge.judge_graph(run, truth[:, :2], AuditConfig(r_in_m=3.0, r_out_m=3.0), 10, None)
    assert [o.method for o in judged.outcomes] == ["top1_gnc", "ours", "oracle"]
    table = {name: values.copy() for name, values in judged.table.items()}
    told = {
        "ours": dict(zip(("closures", "wrong_share", "median_m", "off_share"), ours, strict=True)),
        "top1_gnc": dict(zip(("off_share", "median_m"), every, strict=True)),
        "oracle": dict(zip(("off_share", "median_m"), best, strict=True)),
    }
    for at, name in enumerate(table["method"]):
        for column, value in told[name].items():
            table[column][at] = value
    said = judge.headline(judged._replace(table=table))
    for word in words:
        assert word in said
    assert ("which is better here" in said) == ("which is better here" in words)


def test_a_gate_lets_through_as_many_as_the_promise_allows():
    similarity = np.array([0.9, 0.8, 0.7, 0.7, 0.6, -np.inf])
    is_wrong = np.array([False, False, True, False, False, True])
    assert judge.gate_level(similarity, is_wrong, 0.2) == 0.6
    assert judge.gate_level(similarity, is_wrong, 0.1) == 0.8
    assert judge.gate_level(similarity, ~is_wrong, 0.1) == np.inf
    assert judge.gate_level(np.full(3, -np.inf), np.zeros(3, bool), 0.1) == np.inf


# The command


@pytest.fixture(scope="module")
def audited(tmp_path_factory):
    folder = tmp_path_factory.mktemp("graph")
    data = write_folder(folder / "data", np.random.default_rng(3))
    assert main(["score", str(data), "--out", str(folder / "run"), *FLAGS]) == 0
    assert main(["evaluate", str(folder / "run"), "--truth", str(data / "truth")]) == 0
    return folder


def fails(capsys, code, *words):
    assert main(list(words)) == code
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    return line


@needs_gtsam
def test_the_command_writes_table_picture_and_page(audited, tmp_path, capsys):
    words = ["--out", str(tmp_path), "--no-progress", "--seed", "3"]
    assert main(["graph", str(audited / "run"), *words]) == 0
    said, progress = capsys.readouterr()
    assert "optimising" not in progress
    assert "with the right ones alone" in said
    assert "Odometry noise" in said
    table = read_table(tmp_path / "tables/graph.csv", "graph")
    assert list(table["method"]) == list(judge.TITLES)
    assert (table["seconds"] < 60).all()
    assert (tmp_path / "figures/graph.png").read_bytes().startswith(b"\x89PNG")
    head = (tmp_path / "figures/graph.csv").read_text().splitlines()
    assert head[0].startswith("frame,true_x_m,true_y_m,top1_huber_x_m")
    assert len(head) == 1 + 50 - 25 - 6
    page = (tmp_path / "graph.html").read_text()
    assert "Odometry noise" in page
    assert "data:image/svg+xml" in page


@needs_gtsam
def test_the_report_says_and_draws_what_became_of_the_graph(audited):
    page = (audited / "run/report.html").read_text()
    assert "with all first candidates and GNC it" in page
    assert "What the closures do to the graph" in page
    head = (audited / "run/figures/graph_brief.csv").read_text().splitlines()[0]
    assert head == (
        "frame,true_x_m,true_y_m,top1_gnc_x_m,top1_gnc_y_m,ours_x_m,ours_y_m,oracle_x_m,oracle_y_m"
    )


def test_without_the_extra_the_report_says_how_to_get_it(audited, tmp_path, monkeypatch):
    monkeypatch.setattr(judge, "has_extra", lambda: False)
    run, truth = str(audited / "run"), str(audited / "data/truth")
    assert main(["evaluate", run, "--truth", truth, "--out", str(tmp_path)]) == 0
    html = (tmp_path / "report.html").read_text()
    assert html.count("python -m pip install &#39;taojax[graph]&#39;") == 1
    assert not (tmp_path / "figures/graph_brief.png").exists()


def test_a_missing_extra_is_told_with_the_command_that_installs_it(audited, monkeypatch, capsys):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "gtsam" else found(name, *a)
    )
    line = fails(capsys, 4, "graph", str(audited / "run"))
    assert "python -m pip install 'taojax[graph]'" in line


@needs_gtsam
def test_bad_input_is_one_line(audited, tmp_path, capsys):
    run, truth = audited / "run", audited / "data/truth"
    other = tmp_path / "query_poses.csv"
    other.write_text((truth / "query_poses.csv").read_text().replace("0.0", "0.1", 1))
    line = fails(capsys, 3, "graph", str(run), "--truth", str(tmp_path))
    assert "not the truth that the run was judged with" in line
    assert "no such file" in fails(capsys, 3, "graph", str(run), "--truth", str(tmp_path / "x"))
    bare = tmp_path / "bare"
    shutil.copytree(run, bare)
    for name in ("verdicts.csv", "audit.json"):
        (bare / name).unlink()
    undecided = json.loads((bare / "manifest.json").read_text())
    del undecided["sha256"]["decisions.csv"]
    undecided["seal"] = records.seal_of(undecided)
    (bare / "manifest.json").write_text(json.dumps(undecided))
    line = fails(capsys, 3, "graph", str(bare), "--truth", str(truth))
    assert "nothing is decided here" in line
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["dataset"] = str(tmp_path / "gone")
    manifest["seal"] = records.seal_of(manifest)
    moved = tmp_path / "moved"
    shutil.copytree(run, moved)
    (moved / "manifest.json").write_text(json.dumps(manifest))
    assert "name it with --truth" in fails(capsys, 3, "graph", str(moved))


def test_newer_verdicts_bring_poses_of_their_own(audited, monkeypatch):
    run = records.read_run(audited / "run")
    old = answers.read_answers(audited / "run", run)
    real = pose_graph_io.read_frames

    def newer(path, name, n):
        table = real(path, name, n)
        for suffix, shift in (("", 1.0), ("_now", 2.0)):
            table[f"x{suffix}_m"] = np.full(n, shift)
            table[f"y{suffix}_m"] = np.full(n, 10 * shift)
            table[f"theta{suffix}_rad"] = np.full(n, 0.1 * shift)
        table["verdict_now"] = np.array(["accept"] * n, dtype=object)
        table["probability_wrong"] = np.full(n, 0.25)
        return table | {"probability_wrong_now": np.full(n, 0.5)}

    monkeypatch.setattr(pose_graph_io, "read_frames", newer)
    got = answers.read_answers(audited / "run", run).answers
    np.testing.assert_allclose(got.final.pose[4], [1.0, 10.0, 0.1])
    np.testing.assert_allclose(got.now.pose[4], [2.0, 20.0, 0.2])
    assert got.final.probability_wrong[4] == 0.25
    assert got.now.accepted.all()
    np.testing.assert_array_equal(got.final.accepted, old.answers.final.accepted)
