"""Does an answer agree with the trusted ones before it? A vote over the past, fading with the way.

A false corridor looks right from within for as long as it lasts, and no window that lies inside it
can tell. It cannot undo where the robot was: carried on by odometry, the trusted answers from
before it end elsewhere. Whatever contradicts them has to outlast them, as a kidnapped robot does.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from taojax.config import VerdictConfig
from taojax.core.se2 import compose, inverse

HELD = 512
"""Answers held at most: 256 gaps of way or more, after which they weigh e^-2.6 at most."""

HELD_EVERY = 0.5
"""Gaps of way between two of them: dense frames, and those at a standstill, are one witness."""


class FirstLook(eqx.Module):
    """How far an answer is trusted before its past is asked: a linear model of its other features.

    It is the model of right or wrong without the vote, fitted on the same pooled recordings.
    """

    mean: Float[Array, " f"]
    scale: Float[Array, " f"]
    weight: Float[Array, " f"]
    bias: Float[Array, ""]
    half_trusted: Float[Array, ""]
    """Probability of being wrong at which an answer counts half."""


class History(eqx.Module):
    """Trusted answers, newest last; fixed shapes."""

    local: Float[Array, "h 3"]
    """Where the robot was, in its newest frame."""

    answers: Float[Array, "h 3"]
    """And where it was said to be, map frame."""

    trust: Float[Array, " h"]
    """0 where nothing is held."""

    way_gaps: Float[Array, " h"]
    """Way from each to the newest frame; of the last one, way since any was held."""


def no_history() -> History:
    """Return the history before the first frame."""
    nowhere = jnp.zeros((HELD, 3))
    return History(nowhere, nowhere, jnp.zeros(HELD), jnp.full(HELD, HELD_EVERY))


def push(rows: Array, newest: Array) -> Array:
    """Drop the oldest row and add the newest one."""
    return jnp.concatenate([rows[1:], newest[None]])


def first_trust(first: FirstLook, features: Float[Array, " f"]) -> Float[Array, ""]:
    """Return how far an answer is trusted, 0 to 1, by what is said of it without its past."""
    odds = jnp.sum((features - first.mean) / first.scale * first.weight) + first.bias
    p = jax.nn.sigmoid(odds)
    return 1.0 / (1.0 + (p / first.half_trusted) ** 2)


def contradiction(
    config: VerdictConfig,
    gap_m: Float[Array, ""],
    history: History,
    motion: Float[Array, "3"],
    pose: Float[Array, "3"],
    trust: Float[Array, ""],
) -> tuple[History, Float[Array, ""]]:
    """Let the trusted past vote on an answer, and hold it in its turn.

    An answer that contradicts the past is held with the weight that the vote leaves it, so that a
    row of them does not vouch for itself before it has outlasted what it contradicts.

    Args:
        config: settings.
        gap_m: median distance between neighbouring anchors [m].
        history: of the frames before.
        motion: odometry into this frame.
        pose: its answer, map frame.
        trust: 0 to 1, from `first_trust`.

    Returns:
        The history with this frame, and the log of how much more contradicts the answer than
        agrees with it, one witness given to either side.
    """
    driven = jnp.sqrt(motion[0] ** 2 + motion[1] ** 2) / gap_m
    back = jnp.broadcast_to(inverse(motion), history.local.shape)
    local = compose(back, history.local)
    way = history.way_gaps + driven

    # Carried on, not back: so the headings of the trusted answers count, not the doubtful one's,
    # which fits a mirrored corridor.
    carried = compose(history.answers, inverse(local))
    apart = jnp.sqrt(jnp.sum((carried[:, :2] - pose[None, :2]) ** 2, axis=1)) / gap_m
    # Twice what one answer may be off: both ends are answers.
    is_near = apart <= 2.0 * (config.near_gaps + config.drift * way)
    weight = history.trust * jnp.exp(-way / config.history_gaps)
    agree = jnp.sum(jnp.where(is_near, weight, 0.0))
    against = jnp.sum(jnp.where(is_near, 0.0, weight))

    held = trust * (1.0 + agree) / (1.0 + agree + against)
    after = History(
        push(local, jnp.zeros(3)), push(history.answers, pose), push(history.trust, held),
        push(way, jnp.zeros(())),
    )  # fmt: skip
    kept = History(local, history.answers, history.trust, way)
    is_due = way[-1] >= HELD_EVERY
    after = jax.tree.map(lambda new, old: jnp.where(is_due, new, old), after, kept)
    return after, jnp.log1p(against) - jnp.log1p(agree)
