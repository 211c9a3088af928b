"""The promised false acceptance rate: exact where it can be, simulated where it cannot."""

import numpy as np
import pytest
from scipy import stats

from taojax.audit import conformal, labels
from taojax.errors import ConfigError

OUT_LEVEL = 3.0
N_WORLDS = 300


def splits_of(signal, is_out):
    """Calibration and test: the same frames twice, unless the caller doubled them itself."""
    label = np.where(is_out, "map_out", "in_map")
    return labels.split_frames({"s": signal}, label, calibration_share=0.5, gap_frames=0)


def calibration_of(signal, is_out):
    return splits_of(np.r_[signal, signal], np.r_[is_out, is_out]).calibration


def promise_of(signal, is_out, alpha=0.2, confidence=0.9, block_frames=10):
    return conformal.conformal_threshold(
        calibration_of(signal, is_out), "s",
        alpha=alpha, confidence=confidence, block_frames=block_frames,
    )  # fmt: skip


def draw_world(rng, n_blocks, *, frames=20, in_frames=60, block_sd=0.7, memory=0.7):
    """AR(1) signal; map-out blocks are drawn alike and apart, in excursions of one to four."""
    outside = OUT_LEVEL + ar1(rng, n_blocks, frames, memory)
    outside = outside + block_sd * rng.standard_normal((n_blocks, 1))
    sizes = np.minimum(np.cumsum(rng.integers(1, 5, n_blocks)), n_blocks)
    excursions = [part for part in np.split(outside, sizes) if len(part)]
    inside = ar1(rng, len(excursions), in_frames, memory)
    rows = [(row, part.ravel()) for row, part in zip(inside, excursions, strict=True)]
    signal = np.concatenate([part for pair in rows for part in pair])
    is_out = [np.full(len(part), flag) for pair in rows for flag, part in enumerate(pair)]
    return signal, np.concatenate(is_out).astype(bool)


def ar1(rng, n, frames, memory):
    """Stationary rows of unit variance."""
    noise = rng.standard_normal((n, frames)) * np.sqrt(1 - memory**2)
    noise[:, 0] /= np.sqrt(1 - memory**2)
    lag = np.subtract.outer(np.arange(frames), np.arange(frames))
    return noise @ np.where(lag >= 0, float(memory) ** np.maximum(lag, 0), 0.0).T


def true_rate(threshold, block_sd=0.7):
    """The long-run false acceptance rate of `draw_world`, in closed form."""
    return stats.norm.cdf(threshold, OUT_LEVEL, np.sqrt(1.0 + block_sd**2))


@pytest.mark.parametrize(
    ("alpha", "confidence", "n_blocks", "block_sd"),
    [(0.1, 0.9, 30, 0.7), (0.2, 0.8, 16, 3.0), (0.05, 0.9, 60, 3.0)],
)
def test_the_promise_holds_in_the_promised_share_of_worlds(
    rng, alpha, confidence, n_blocks, block_sd
):
    rates = []
    for _ in range(N_WORLDS):
        signal, is_out = draw_world(rng, n_blocks, block_sd=block_sd)
        made = promise_of(signal, is_out, alpha, confidence, block_frames=20)
        assert made.n_blocks == n_blocks
        rates.append(true_rate(made.threshold, block_sd))
    n_broken = int(np.sum(np.array(rates) > alpha))
    # Binomial slack: a procedure that keeps its word exceeds this once in a thousand.
    assert n_broken <= stats.binom.ppf(0.999, N_WORLDS, 1 - confidence)
    assert np.mean(rates) >= alpha / 20, "the promise is kept by accepting next to nothing"


def test_the_realised_rate_of_a_held_out_half_keeps_the_promise_too(rng):
    rates = []
    for _ in range(N_WORLDS // 2):
        halves = [draw_world(rng, 12, block_sd=0.7) for _ in range(2)]
        # Excursions differ in number: pad the shorter half with in-map frames at its end.
        longest = max(len(signal) for signal, _ in halves)
        signal = np.concatenate([np.pad(s, (0, longest - len(s))) for s, _ in halves])
        is_out = np.concatenate([np.pad(o, (0, longest - len(o))) for _, o in halves])
        cut = splits_of(signal, is_out)
        made = conformal.conformal_threshold(
            cut.calibration, "s", alpha=0.2, confidence=0.9, block_frames=20
        )
        rates.append(conformal.realised(cut.test, "s", made))
    assert np.sum(np.array(rates) > 0.2) <= stats.binom.ppf(0.999, N_WORLDS // 2, 0.1)


@pytest.mark.parametrize(("n_blocks", "alpha"), [(11, 0.2), (30, 0.1), (200, 0.1), (90, 0.3)])
def test_betting_is_fair_at_alpha_and_wins_no_more_often_than_promised(n_blocks, alpha):
    lost = np.arange(n_blocks + 1)
    wealth = np.array([
        conformal.log_wealth(np.r_[np.ones(k), np.zeros(n_blocks - k)], alpha, 0.9) for k in lost
    ])  # fmt: skip
    chance = stats.binom.pmf(lost, n_blocks, alpha)
    assert np.sum(chance * np.exp(wealth)) == pytest.approx(1.0)
    assert np.sum(chance[wealth >= np.log(10.0)]) <= 0.1 + 1e-12


@pytest.mark.parametrize("n_blocks", [1, 3, 22, 100])
def test_the_least_rate_is_the_exact_binomial_bound_after_no_event(n_blocks):
    exact = stats.beta.ppf(0.9, 1, n_blocks)
    least = conformal.least_alpha(n_blocks, 0.9)
    assert least == pytest.approx(exact)
    assert stats.binom.cdf(0, n_blocks, least) == pytest.approx(0.1)
    signal, is_out = np.r_[np.zeros(20), np.ones(5 * n_blocks)], np.arange(5 * n_blocks + 20) >= 20
    assert promise_of(signal, is_out, least, 0.9, 5).threshold == 0.0
    assert promise_of(signal, is_out, least * 0.999, 0.9, 5).threshold == -np.inf


def test_many_blocks_beat_the_hoeffding_bentkus_bound(rng):
    loss, alpha = np.minimum(rng.exponential(0.06, 80), 1.0), 0.1
    mean = loss.mean()
    relative = mean * np.log(mean / alpha) + (1 - mean) * np.log((1 - mean) / (1 - alpha))
    bentkus = np.e * stats.binom.cdf(np.ceil(80 * mean), 80, alpha)
    assert np.exp(-conformal.log_wealth(loss, alpha, 0.9)) < min(np.exp(-80 * relative), bentkus)


def test_too_few_blocks_promise_nothing_and_say_what_could_be_promised(rng):
    signal, is_out = draw_world(rng, 5)
    made = promise_of(signal, is_out, 0.1, 0.9, block_frames=20)
    assert made.threshold == -np.inf
    assert made.n_blocks == 5
    assert made.least_alpha == pytest.approx(1 - 0.1 ** (1 / 5))
    for said in ("No threshold", "22 blocks", "holds 5", "37 %", "20 or more", "exchangeable"):
        assert said in made.sentence


def test_a_promise_says_its_rate_its_confidence_and_its_assumption(rng):
    made = promise_of(*draw_world(rng, 30), 0.1, 0.9, block_frames=20)
    assert np.isfinite(made.threshold)
    for said in ("10 %", "90 %", "30 blocks", "blocks of 20 or more", "exchangeable"):
        assert said in made.sentence


def test_without_map_out_frames_nothing_is_promised_or_realised():
    signal = np.linspace(0.0, 1.0, 50)
    made = promise_of(signal, np.zeros(50, bool))
    assert (made.threshold, made.n_blocks, made.least_alpha) == (-np.inf, 0, 1.0)
    assert "no rate" in made.sentence
    test = splits_of(np.r_[signal, signal], np.zeros(100, bool)).test
    assert np.isnan(conformal.realised(test, "s", made))


def test_map_out_frames_alone_suffice_for_a_threshold(rng):
    signal = rng.normal(size=220)
    made = promise_of(signal, np.ones(220, bool), 0.1)
    assert -np.inf < made.threshold < signal.min()


def test_ties_are_accepted_or_rejected_together(rng):
    signal, is_out = draw_world(rng, 40)
    coarse = np.round(signal)
    made = promise_of(coarse, is_out, block_frames=20)
    assert made.threshold in coarse
    assert np.mean(coarse[is_out] <= made.threshold) <= 0.2
    flat = promise_of(np.ones(400), np.arange(400) >= 100)
    assert flat.threshold < 1.0, "a constant signal must be rejected as a whole"


def test_one_lost_block_among_many_is_not_the_end():
    signal = np.r_[np.full(10, 0.5), np.full(990, 1.0)]
    made = promise_of(signal, np.ones(1000, bool), 0.1)
    assert made.threshold == 0.5
    test = splits_of(np.r_[signal, signal], np.ones(2000, bool)).test
    assert conformal.realised(test, "s", made) == pytest.approx(0.01)


def test_a_threshold_keeps_its_meaning_in_single_precision(rng):
    signal, is_out = draw_world(rng, 11)
    single = signal[is_out].astype(np.float32)
    least = conformal.least_alpha(11, 0.9)  # not one map-out frame may be accepted
    made = promise_of(single, np.ones(len(single), bool), least, block_frames=20)
    assert not (single <= made.threshold).any()


def test_frames_without_a_signal_are_never_accepted(rng):
    signal, is_out = draw_world(rng, 30)
    gaps = np.where(np.arange(len(signal)) % 7 == 0, np.nan, signal)
    assert promise_of(gaps, is_out).threshold >= promise_of(signal, is_out).threshold
    assert not np.isnan(promise_of(np.full(200, np.nan), np.ones(200, bool)).threshold)


def test_a_looser_promise_never_lowers_the_threshold(rng):
    for n_blocks in (8, 25, 70):
        signal, is_out = draw_world(rng, n_blocks)
        made = [promise_of(signal, is_out, a, block_frames=20) for a in np.linspace(0.02, 0.9, 30)]
        assert (np.diff([max(m.threshold, -1e9) for m in made]) >= 0).all()
        assert all(np.isfinite(m.threshold) == (m.alpha >= m.least_alpha) for m in made)


def test_the_threshold_follows_any_rising_map_of_the_signal(rng):
    signal, is_out = draw_world(rng, 30)
    plain, cubed = promise_of(signal, is_out), promise_of(signal**3, is_out)
    assert cubed.threshold == pytest.approx(plain.threshold**3)


def test_a_label_that_flickers_makes_no_blocks(rng):
    signal, is_out = rng.normal(size=400), np.arange(400) % 2 == 0
    assert promise_of(signal, is_out, block_frames=20).n_blocks == 10


def test_the_test_split_is_refused(rng):
    signal, is_out = draw_world(rng, 11)
    test = splits_of(np.r_[signal, signal], np.r_[is_out, is_out]).test
    with pytest.raises(Exception, match="TestSplit"):
        conformal.conformal_threshold(test, "s", alpha=0.2, confidence=0.9, block_frames=20)


@pytest.mark.parametrize(
    "wrong", [{"alpha": 0.0}, {"alpha": 1.0}, {"confidence": 1.0}, {"block_frames": 0}]
)
def test_impossible_promises_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        promise_of(np.zeros(40), np.ones(40, bool), **wrong)
