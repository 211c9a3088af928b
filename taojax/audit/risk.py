"""Right or wrong: the judge's labels of answers, risk numbers refined by them, risk-coverage."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from taojax.audit.calibration import CORRELATED_FRAMES, moved
from taojax.audit.labels import CalibrationSplit
from taojax.risk import Risk, at_most, probability_wrong

HARSHER = 4.0
"""The odds of being wrong may be so many times higher on the frames to come than on the
calibration half: each wrong answer there counts as so many. (mit_corridor: .45 of one half are
wrong, .80 of the other: odds five times as high.) From 2 to 6 nothing changes on left-out
recordings by more than .015 in recall or .007 in wrong share."""

LEAST_RIGHT = 20
"""Right answers in the calibration half below which it cannot set a level, only the pooled one."""

LEAST_ACCEPTED = 3
"""Right answers that a level must accept there to stand: of fewer nothing can be checked. With 10
instead the recall on left-out recordings is .01 lower and no fewer accepted answers are wrong."""

ENOUGH, RISE = 0.95, 5.0 / 3.0
"""A half that accepts `LEAST_RIGHT` right answers up to the pooled level may raise it until it
accepts so large a share of its right answers, and to so many times the pooled one at most. On
left-out recordings recall goes from .752 to .776 with it (wrong .0175 and .0179), of causal answers
from .725 to .746 (.0264 and .0265). Nine in ten and twice is as good (.779, .0181); without a share
it is .782, but radar_kaist01, whose half accepts .98 as it is, would buy two right answers for
twelve wrong ones; at 2.5 times wrong is .033."""

FOLDS = 4
"""Parts of the calibration half, each judged by numbers fitted on the others before a level is
read off it. With the numbers fitted on all of it, radar_dcc01 has .13 wrong instead of .05."""


class Own(NamedTuple):
    """What became of one kind of answer; frames whose answer is right off the map are neither."""

    is_right: Bool[np.ndarray, " n"]
    """Within wrong_m of the truth, and a map pose within r_out."""

    is_wrong: Bool[np.ndarray, " n"]
    """Farther than wrong_m from the truth."""

    def at(self, frames: np.ndarray) -> "Own":
        """Return the labels of some frames."""
        return Own(self.is_right[frames], self.is_wrong[frames])


class Answers(NamedTuple):
    """Right or wrong, now and finally."""

    now: Own
    final: Own

    def of(self, signal: str) -> Own:
        """Return the labels by which a signal is judged: the final answer's, but for its own."""
        return self.now if signal == NOW else self.final

    def at(self, frames: np.ndarray) -> "Answers":
        """Return the labels of some frames."""
        return Answers(self.now.at(frames), self.final.at(frames))


FINAL, NOW = "probability_wrong", "probability_wrong_now"
"""Rows of metrics.csv."""


def own_answers(
    error_m: Float[np.ndarray, " n"],
    nearest_m: Float[np.ndarray, " n"],
    wrong_m: float,
    r_out_m: float,
) -> Own:
    """Label answers by their distance from the truth.

    Args:
        error_m: distance of the answered from the true position, metres.
        nearest_m: distance of the true position from the nearest map pose, metres.
        wrong_m: an answer farther off is wrong.
        r_out_m: a frame farther from the map has no right closure.
    """
    is_near = error_m <= wrong_m
    return Own(is_near & (nearest_m <= r_out_m), ~is_near)


def refine(base: Risk, split: CalibrationSplit, own: Own, max_wrong: float) -> Risk:
    """Refine the pooled numbers by the labelled answers of a calibration half.

    Args:
        base: the shipped numbers.
        split: frames that may be fitted on, with the columns that `base` reads.
        own: right or wrong, of the same frames.
        max_wrong: share of the accepted answers that may be wrong.

    Returns:
        Weights half of the way from the pooled to the fitted ones. The level is the highest one at
        which the accepted answers of this half keep the promise though each wrong one counts
        `HARSHER` times, at most `highest_level`; NaN, and a sentence why, where none does.
    """
    table = np.stack([np.asarray(split.signals[name], float) for name in base.columns], axis=1)
    z, known = (table - base.mean) / base.scale, np.flatnonzero(own.is_right | own.is_wrong)
    refined = _moved(base, z[known], own.is_wrong[known])
    p = np.array(probability_wrong(refined, split.signals))
    # A level is checked on answers that the numbers have not seen: every part by the other parts'.
    unseen = p.copy()
    for part in np.array_split(known, FOLDS):
        others = np.setdiff1d(known, part)
        if part.size and others.size:
            there = {name: split.signals[name][part] for name in base.reads}
            apart = _moved(base, z[others], own.is_wrong[others])
            unseen[part] = probability_wrong(apart, there)
    levels = np.array([
        checked_level(unseen, own, most, highest_level(unseen, own, level))
        for level, most in zip(base.levels, base.max_wrongs, strict=True)
    ])  # fmt: skip
    refined = at_most(refined._replace(levels=levels), max_wrong)
    return refined._replace(promise=promise_words(refined, unseen, own))


def _moved(base: Risk, z: Float[np.ndarray, "n f"], is_wrong: Bool[np.ndarray, " n"]) -> Risk:
    """Return the numbers moved part of the way to what fits some labelled answers."""
    numbers = moved(np.append(base.weight, base.bias), z, is_wrong)
    return base._replace(weight=numbers[:-1], bias=float(numbers[-1]))


def highest_level(p: Float[np.ndarray, " n"], own: Own, pooled: float) -> float:
    """Return how high a calibration half may set the level: the pooled one or a higher.

    Args:
        p: probability of being wrong.
        own: right or wrong, of the same answers.
        pooled: the level of the pooled numbers; NaN stays NaN.
    """
    right = np.sort(p[own.is_right])
    if not np.sum(right <= pooled) >= LEAST_RIGHT:
        return pooled
    enough = float(right[int(np.ceil(ENOUGH * len(right))) - 1])
    # What is more likely wrong than right is never accepted.
    return max(pooled, min(enough, RISE * pooled, 0.5))


def checked_level(
    p: Float[np.ndarray, " n"], own: Own, max_wrong: float, pooled: float = 1.0
) -> float:
    """Return the highest level at which accepted answers keep the promise in a harsher world.

    Args:
        p: probability of being wrong.
        own: right or wrong, of the same answers.
        max_wrong: share of the accepted answers that may be wrong.
        pooled: the level of the pooled numbers; no higher one is returned.

    Returns:
        NaN where no level keeps it. Where too few answers are right to tell, the pooled level, but
        NaN if that would accept any wrong one.
    """
    if own.is_right.sum() < LEAST_RIGHT:
        return float("nan") if np.any(own.is_wrong & (p <= pooled)) else pooled
    value, wrong, n_right, is_last = _sorted(p, own)
    n_wrong = HARSHER * wrong
    keeps = is_last & (n_right >= LEAST_ACCEPTED) & (n_wrong <= max_wrong * (n_wrong + n_right))
    if not keeps.any():
        return float("nan")
    level = min(pooled, float(value[np.flatnonzero(keeps)[-1]]))
    accepted = int(np.sum(own.is_right & (p <= level)))
    return level if accepted >= LEAST_ACCEPTED else float("nan")


CONFIDENCE = 0.9
"""Of the promise, where the calibration half is long enough to make one."""


def promise_words(refined: Risk, p: Float[np.ndarray, " n"], own: Own) -> str:
    """Say what is promised and on what assumption, or what is missing.

    Args:
        refined: with its levels.
        p: probability of being wrong of the calibration half, by numbers that have not seen it.
        own: right or wrong, of the same.
    """
    from scipy.stats import binom

    most, n_right, n_wrong = refined.max_wrong, int(own.is_right.sum()), int(own.is_wrong.sum())
    half = f"the calibration half ({n_right} right and {n_wrong} wrong answers)"
    if np.isnan(refined.level):
        kept = [m for m, x in zip(refined.max_wrongs, refined.levels, strict=True) if x == x]
        could = (
            f"--max-wrong {min(kept):g} could be kept" if kept else "no --max-wrong could be kept"
        )
        why = (
            f"even the most trusted answers are wrong too often for {most:.0%} when each wrong one "
            f"counts {HARSHER:g} times or too few right ones are trusted"
        )
        if n_right < LEAST_RIGHT:
            why = f"wrong answers look right and fewer than {LEAST_RIGHT} are right"
        if not n_right:
            return (
                f"nothing is accepted: in {half} nothing is right; do the rows of the descriptors"
                " follow those of the poses and of the odometry, and have both one clock?"
            )
        return (
            f"nothing is accepted: in {half} {why}; {could}; better descriptors or a longer drive "
            "on the map would help"
        )
    if n_right < LEAST_RIGHT:
        return (
            f"at most {most:.0%} of the accepted answers wrong on the evidence of pooled "
            f"recordings alone: {half} is too short to check it; {LEAST_RIGHT} right answers are "
            "needed"
        )
    accepted = p <= refined.level
    n, k = (accepted & (own.is_right | own.is_wrong)).sum(), (accepted & own.is_wrong).sum()
    blocks, bad = int(n / CORRELATED_FRAMES), int(np.ceil(k / CORRELATED_FRAMES))
    said = f"{k} of {n} accepted answers are wrong in {half}"
    if blocks and binom.cdf(bad, blocks, most) <= 1.0 - CONFIDENCE:
        return (
            f"at most {most:.0%} of the accepted answers wrong with {CONFIDENCE:.0%} confidence if "
            f"blocks of {CORRELATED_FRAMES:g} frames are exchangeable: {said}"
        )
    need = int(np.ceil(np.log(1.0 - CONFIDENCE) / np.log1p(-most)) * CORRELATED_FRAMES)
    return (
        f"at most {most:.0%} of the accepted answers wrong as measured on {n} and not proven: "
        f"{said}; "
        f"{need} accepted answers without a wrong one would prove it with {CONFIDENCE:.0%} "
        "confidence"
    )


def _sorted(signal: np.ndarray, own: Own) -> tuple[np.ndarray, ...]:
    """Return values, wrong and right so far, and where ties end, most trusted first.

    Ties count against.
    """
    known = own.is_right | own.is_wrong
    order = np.lexsort((~own.is_wrong[known], signal[known]))
    value, wrong = signal[known][order], own.is_wrong[known][order]
    is_last = np.append(value[1:] > value[:-1], True)[: len(value)]
    return value, np.cumsum(wrong), np.cumsum(~wrong), is_last


def risk_row(signal: Float[np.ndarray, " n"], own: Own) -> dict[str, float]:
    """Return the area under the risk-coverage curve and recall at 95 and 99 % precision.

    Args:
        signal: larger = less trusted.
        own: right or wrong, of the same answers.

    Returns:
        Empty without answers or with a NaN; no recall without a right answer.

    Source:
        Geifman & El-Yaniv, NeurIPS 2017 (selective risk).
    """
    if np.isnan(signal).any() or not (own.is_right | own.is_wrong).any():
        return {}
    _, wrong, right, is_last = _sorted(signal, own)
    row = {"aurc": float(np.mean(wrong / (wrong + right)))}
    if right[-1]:
        for name, precision in (("recall_at_p95", 0.95), ("recall_at_p99", 0.99)):
            keeps = is_last & (right >= precision * (wrong + right))
            row[name] = float(right[keeps].max() / right[-1]) if keeps.any() else 0.0
    return row


def level_row(
    seen: Float[np.ndarray, " c"],
    own_seen: Own,
    tested: Float[np.ndarray, " n"],
    own_tested: Own,
    max_wrong: float,
) -> dict[str, float]:
    """Return what any signal accepts under the rule that sets the verdicts' level.

    Args:
        seen: signal of the calibration half; larger = less trusted.
        own_seen: right or wrong, of its answers.
        tested: signal of the test half.
        own_tested: right or wrong, of its answers.
        max_wrong: share of the accepted answers that may be wrong.

    Returns:
        The level, the share of the right test answers that it accepts, and of the accepted ones
        that are wrong; no level where nothing may be accepted, and no share of nothing.
    """
    if np.isnan(seen).any() or np.isnan(tested).any():
        return {}
    level = checked_level(seen, own_seen, max_wrong, np.inf)
    accepted = tested <= level
    n_right, n_wrong = ((accepted & part).sum() for part in own_tested)
    row = {"risk_level": level} if np.isfinite(level) else {}
    if own_tested.is_right.any():
        row["risk_recall"] = float(n_right / own_tested.is_right.sum())
    if n_right + n_wrong:
        row["risk_wrong"] = float(n_wrong / (n_right + n_wrong))
    return row


def risk_coverage(
    signal: Float[np.ndarray, " n"], own: Own, steps: int = 100
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Return coverage in even steps, and the share of wrong answers among those accepted.

    Args:
        signal: larger = less trusted.
        own: right or wrong, of the same answers.
        steps: of coverage.
    """
    if np.isnan(signal).any() or not (own.is_right | own.is_wrong).any():
        return np.zeros(0), np.zeros(0)
    _, wrong, right, _ = _sorted(signal, own)
    coverage = np.arange(1, steps + 1) / steps
    rows = np.maximum(np.ceil(coverage * len(wrong)).astype(int), 1) - 1
    return coverage, wrong[rows] / (wrong[rows] + right[rows])
