"""A threshold with a promise: at most this share of map-out frames is accepted.

Neighbouring frames are alike, so frames are no sample; blocks of them are taken as one. Every
block bets against "the rate is above alpha": the wealth after n blocks is the product of
1 - s + s * (1 - loss) / (1 - alpha), where the loss is the share of its frames that a threshold
accepts. If the mean loss is alpha or more, each factor is at most 1 in expectation, so wealth
reaches 1 / (1 - confidence) with probability at most 1 - confidence (Markov). Wealth falls as the
threshold rises; the largest threshold that passes is therefore chosen without further cost.
"""

import bisect
import dataclasses
import math

import numpy as np
from jaxtyping import Float

from taojax.audit.labels import CalibrationSplit, TestSplit
from taojax.errors import ConfigError

_ROUNDING = 1e-9  # in log wealth: exactly enough blocks must count as enough


@dataclasses.dataclass(frozen=True)
class Promise:
    """A frozen threshold and what is promised of it."""

    threshold: float
    """Accept where signal <= threshold; -inf = nothing can be promised but to reject everything."""

    alpha: float
    """Largest false acceptance rate."""

    confidence: float
    """Probability, over calibration recordings, that the promise holds."""

    n_blocks: int
    """Blocks of map-out calibration frames that it rests on."""

    least_alpha: float
    """Smallest alpha for which so many blocks can give a threshold; 1 = none."""

    sentence: str
    """The promise and its assumption in words."""


def least_alpha(n_blocks: int, confidence: float) -> float:
    """Return the smallest rate that can be promised, which is with no frame of any block accepted.

    Args:
        n_blocks: blocks of map-out calibration frames.
        confidence: in (0, 1).

    Returns:
        The exact binomial upper bound after no event in n trials; 1 without a block.

    Source:
        Clopper & Pearson, Biometrika 26, 1934.
    """
    return 1.0 - (1.0 - confidence) ** (1.0 / n_blocks) if n_blocks else 1.0


def log_wealth(loss: Float[np.ndarray, " n"], alpha: float, confidence: float) -> float:
    """Return the logarithm of what betting against a rate above alpha has won.

    The stake s is everything while blocks are few, so that no test needs fewer of them, and falls
    as 1 / sqrt(n) from twice that many on, so that one lost block is not the end. It depends on
    no outcome, and the wealth rises with alpha.

    Args:
        loss: share of frames accepted, per block.
        alpha: the rate, in (0, 1).
        confidence: in (0, 1).

    Returns:
        At least -log(1 - confidence) with probability at most 1 - confidence for independent
        blocks whose mean expected loss is alpha or more; -inf = everything lost.

    Source:
        Waudby-Smith & Ramdas, JRSS B 86, 2024 (betting); Bates et al., J. ACM 68, 2021 (risk
        control through monotone losses).
    """
    needed = math.log1p(-confidence) / math.log1p(-alpha)
    stake = min(1.0, math.sqrt(2.0 * needed / len(loss)))
    with np.errstate(divide="ignore"):
        return float(np.log(1.0 - stake + stake * (1.0 - loss) / (1.0 - alpha)).sum())


def _percent(share: float) -> str:
    # Rounded up: a promise may be told as weaker than it is, never as stronger.
    return f"{math.ceil(share * 1000.0 - 1e-6) / 10.0:g} %"


def _sentence(
    n_blocks: int, needed: int, alpha: float, confidence: float, block_frames: int
) -> str:
    sure = f"with {100.0 * confidence:g} % confidence"
    assumed = (
        f"assuming that blocks of {block_frames} or more consecutive map-out frames are "
        "exchangeable, within the calibration split and with what follows"
    )
    if n_blocks >= needed:
        return (
            f"In the long run at most {_percent(alpha)} of map-out frames are accepted at this "
            f"threshold, promised {sure} from {n_blocks} blocks of the calibration split and "
            f"{assumed}; the rate over one short stretch may still be higher."
        )
    least = _percent(least_alpha(n_blocks, confidence))
    best = (
        f"the least rate that so few can promise is {least}"
        if n_blocks
        else "no rate can be promised"
    )
    return (
        f"No threshold can promise {sure} that at most {_percent(alpha)} of map-out frames are "
        f"accepted: that takes {needed} blocks of the calibration split and it holds {n_blocks} "
        f"({assumed}); only rejecting every frame is sure, and {best}."
    )


def conformal_threshold(
    calibration: CalibrationSplit,
    name: str,
    *,
    alpha: float,
    confidence: float,
    block_frames: int,
) -> Promise:
    """Choose the largest threshold whose false acceptance rate is promised to be at most alpha.

    The map-out frames, laid end to end in order of time, are cut into as many blocks of at least
    `block_frames` as they fill, so that a label that flickers makes no blocks.

    Args:
        calibration: frames that may be fitted on.
        name: the signal, larger = more likely map-out; a frame with NaN is never accepted.
        alpha: largest share of map-out frames accepted in the long run, in (0, 1).
        confidence: probability, over calibration recordings, that this holds, in (0, 1).
        block_frames: map-out frames per block, at least as many as a signal remembers.

    Returns:
        The promise; its threshold is the largest calibration value of any label that passes (just
        below the lowest if none does), or -inf where blocks are too few for any threshold.

    Raises:
        ConfigError: alpha or confidence outside (0, 1), or a block of no frame.

    Source:
        Angelopoulos et al., Learn then Test, 2021 (fixed-sequence testing).
    """
    if not (0.0 < alpha < 1.0 and 0.0 < confidence < 1.0):
        raise ConfigError(
            f"alpha ({alpha}) and confidence ({confidence}) must lie between 0 and 1, ends excluded"
        )
    if block_frames < 1:
        raise ConfigError(f"block_frames must be at least 1, got {block_frames}")
    signal = calibration.signals[name]
    signal = np.where(np.isnan(signal), np.inf, signal)
    outside = signal[calibration.is_out]
    n_blocks = len(outside) // block_frames
    needed = math.log1p(-confidence) / math.log1p(-alpha)
    enough = math.ceil(needed * (1.0 - _ROUNDING))
    threshold = -math.inf
    if n_blocks >= enough:
        starts = np.arange(n_blocks) * len(outside) // n_blocks
        sizes = np.diff(starts, append=len(outside))
        rates = lambda level: np.add.reduceat(outside <= level, starts, dtype=float) / sizes
        bar = -math.log1p(-confidence) - _ROUNDING
        fails = lambda level: log_wealth(rates(level), alpha, confidence) < bar
        # Accepting every map-out frame always fails, so the first failure exists.
        levels = np.unique(outside)
        limit = levels[bisect.bisect_left(levels, True, key=fails)]
        below = signal[signal < limit]
        threshold = float(below.max() if below.size else np.nextafter(limit, -np.inf))
    return Promise(
        threshold=threshold,
        alpha=alpha,
        confidence=confidence,
        n_blocks=n_blocks,
        least_alpha=least_alpha(n_blocks, confidence),
        sentence=_sentence(n_blocks, enough, alpha, confidence, block_frames),
    )


def realised(test: TestSplit, name: str, promise: Promise) -> float:
    """Return the false acceptance rate on the test split, to be printed beside the promise.

    Args:
        test: held-out frames.
        name: the signal.
        promise: from `conformal_threshold`.

    Returns:
        Share of map-out frames accepted; NaN without one.
    """
    outside = test.signals[name][test.is_out]
    return float(np.mean(outside <= promise.threshold)) if outside.size else float("nan")
