"""A Bayes filter over the map's anchors, in both travel directions, and one state off the map.

A hypothesis is an anchor with a travel direction: as the map drove there, or the other way.
Forwards in time the filter gives the causal belief; run over the frames that follow, with every
motion reversed, it gives what the future says of a frame, and the product of both is the smoothed
belief.
Everything here is a pure function of one frame; `runtime/hindsight.py` scans it over a log.

Source: Rabiner, Proc. IEEE 77(2), 1989 (forward-backward); the off state follows TopometricLoc.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.config import VerdictConfig
from taojax.core.anchors import AnchorGrid, look_up
from taojax.core.reductions import first_argmin
from taojax.core.se2 import compose, inverse, rotate

_TINY = 1e-30


class Belief(eqx.Module):
    """Probabilities that sum to one."""

    mass: Float[Array, "2 m"]
    """Of every anchor, travelled as the map was and the other way."""

    off: Float[Array, ""]
    """Of being off the map."""


class Places(eqx.Module):
    """The map as the filter sees it."""

    grid: AnchorGrid
    gap_m: Float[Array, ""]
    """Median distance between neighbouring anchors, whatever the order of the map's rows."""

    unit_m: Float[Array, ""]
    """Way over which one whole piece of evidence is gathered."""

    n_known: Float[Array, ""]
    """Anchors that exist; rows from there on are padding, without mass for ever."""


def uninformed(
    config: VerdictConfig, n_anchors: int, n_known: Float[Array, ""] | None = None
) -> Belief:
    """Return the belief before any frame: anywhere.

    Args:
        config: the prior of being off the map.
        n_anchors: rows.
        n_known: how many of them exist; all when omitted.
    """
    # Explicit types: a weakly typed start would compile the second step again.
    off = jnp.asarray(config.start_off, jnp.float32)
    n = jnp.asarray(n_anchors if n_known is None else n_known, jnp.float32)
    is_known = (jnp.arange(n_anchors, dtype=jnp.float32) < n).astype(jnp.float32)
    return Belief(jnp.broadcast_to(is_known * ((1.0 - off) / (2 * n)), (2, n_anchors)), off)


def _spread(
    grid: AnchorGrid, variance: Float[Array, ""], mass: Float[Array, "2 m"]
) -> Float[Array, "2 m"]:
    """Return the mass after positions spread over the neighbours.

    Neighbour by neighbour: summing a gathered `(2, m, b)` array takes seven times as long. A loop,
    because XLA takes twelve times as long to compile what is written out.
    """

    def add(sums: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        kernel = jnp.exp(-0.5 * b[1] / variance)
        return (sums[0] + kernel, sums[1] + kernel[None] * mass[:, b[0]]), None

    zero = jnp.zeros_like(mass[0]), jnp.zeros_like(mass)
    weight, spread = jax.lax.scan(add, zero, (grid.neighbour, grid.neighbour_m2))[0]
    return spread / weight[None]


def predict(
    config: VerdictConfig, places: Places, belief: Belief, motion: Float[Array, "3"]
) -> Belief:
    """Carry the belief over one motion.

    Args:
        config: how often a robot leaves the map and comes back, per unit of way.
        places: the map.
        belief: before the motion.
        motion: forward [m], left [m], yaw [rad]; its inverse carries a belief back in time.

    Returns:
        The belief after it. What would have come from outside the map is off it now.
    """
    grid, gap_m = places.grid, places.gap_m
    is_known = jnp.arange(grid.xy.shape[0], dtype=jnp.float32) < places.n_known
    driven = jnp.sqrt(motion[0] ** 2 + motion[1] ** 2)
    units = jnp.minimum(1.0, driven / places.unit_m)
    stays_on = (1.0 - config.leave) ** units
    stays_off = (1.0 - config.come_back) ** units
    variance = (0.5 * gap_m) ** 2 + (0.15 * driven) ** 2
    spread = _spread(grid, variance, belief.mass)

    # Whoever faced the other way came from the other side. Coordinates are gathered one by one:
    # pairs of them, gathered and multiplied, take ten times as long on a CPU.
    x, y = grid.xy[:, 0], grid.xy[:, 1]
    c, s = grid.facing[:, 0], grid.facing[:, 1]
    turned = rotate(-motion[2], grid.facing)
    cos, sin = turned[:, 0], turned[:, 1]
    dx, dy = motion[0] * cos - motion[1] * sin, motion[0] * sin + motion[1] * cos
    before_x, before_y = jnp.stack([x - dx, x + dx]), jnp.stack([y - dy, y + dy])
    known, away = look_up(grid, before_x, before_y)
    is_linked = away < (config.reach_gaps * gap_m) ** 2
    # A loop driven the other way later has anchors that face against their neighbours.
    is_same = c[known] * cos[None] + s[known] * sin[None] >= 0
    direction = jnp.array([[0], [1]])
    arriving = spread[jnp.where(is_same, direction, 1 - direction), known]
    arriving = jnp.where(is_linked, stays_on * arriving, 0.0)
    gone = jnp.maximum(1.0 - belief.off - jnp.sum(arriving), 0.0)
    back = (1.0 - stays_off) * belief.off
    anywhere = jnp.where(is_known, back / (2 * places.n_known), 0.0)
    return _normalised(arriving + anywhere[None], belief.off - back + gone)


def _normalised(mass: Float[Array, "2 m"], off: Float[Array, ""]) -> Belief:
    scale = 1.0 / jnp.maximum(jnp.sum(mass) + off, _TINY)
    return Belief(mass * scale, off * scale)


def weigh(belief: Belief, index: Int[Array, " c"], log_evidence: Float[Array, " c"]) -> Belief:
    """Multiply the belief by what one frame's list says.

    Args:
        belief: before the list is seen.
        index: `(c,)` anchors that the list names, -1 = none.
        log_evidence: `(c,)` log likelihood ratio against background. An anchor that the list lacks
            looks like background, and so does everything off the map: their evidence is 0.
    """
    m = belief.mass.shape[1]
    listed = jnp.where(index >= 0, index, m)
    evidence = jnp.ones(m).at[listed].set(jnp.exp(log_evidence), mode="drop")
    return _normalised(belief.mass * evidence[None], belief.off)


def combined(
    config: VerdictConfig,
    forward: Belief,
    backward: Belief,
    n_known: Float[Array, ""] | None = None,
) -> Belief:
    """Return the smoothed belief of a frame.

    Args:
        config: the prior that both halves contain.
        forward: from all frames up to this one.
        backward: from the frames after this one, carried back to it.
        n_known: anchors that exist; all rows when omitted.
    """
    m = forward.mass.shape[1] if n_known is None else n_known
    on = jnp.maximum(1.0 - config.start_off, _TINY) / (2 * m)
    off = jnp.maximum(config.start_off, _TINY)
    return _normalised(forward.mass * backward.mass / on, forward.off * backward.off / off)


class Reading(eqx.Module):
    """What a belief says of the robot's place."""

    pose: Float[Array, "3"]
    """x [m], y [m], theta [rad] in the map."""

    map_index: Int[Array, ""]
    """The likeliest anchor."""

    here: Float[Array, ""]
    """Probability of the place around it, in the direction it is travelled."""

    turned: Float[Array, ""]
    """Of the same place, travelled the other way."""

    off: Float[Array, ""]
    """Of being off the map."""

    rival: Float[Array, ""]
    """Of the likeliest hypothesis elsewhere, relative to the likeliest one."""

    covariance: Float[Array, "3"]
    """Variance of x and y and their covariance within the place [m^2]."""


def read(
    config: VerdictConfig, places: Places, belief: Belief, since: Float[Array, "3"]
) -> Reading:
    """Read off the most likely place.

    Args:
        config: how wide one place is.
        places: the map.
        belief: of the last transition.
        since: motion driven after it.

    Returns:
        The mean of the hypotheses around the likeliest one that face as it does, moved by `since`.
    """
    grid, gap_m = places.grid, places.gap_m
    m = grid.xy.shape[0]
    best = first_argmin(-belief.mass.reshape(-1))
    anchor, sign = best % m, jnp.where(best >= m, -1.0, 1.0)
    ahead = sign * grid.facing[anchor]
    dx, dy = grid.xy[:, 0] - grid.xy[anchor, 0], grid.xy[:, 1] - grid.xy[anchor, 1]
    is_near = dx**2 + dy**2 <= (config.place_gaps * gap_m) ** 2
    agrees = grid.facing[:, 0] * ahead[0] + grid.facing[:, 1] * ahead[1] >= 0
    same = jnp.where(is_near, jnp.where(agrees, belief.mass[0], belief.mass[1]), 0.0)
    other = jnp.where(is_near, jnp.where(agrees, belief.mass[1], belief.mass[0]), 0.0)
    here = jnp.sum(same)
    weight = same / jnp.maximum(here, _TINY)
    mx, my = jnp.sum(weight * dx), jnp.sum(weight * dy)
    face = jnp.where(agrees, 1.0, -1.0)
    c = jnp.sum(weight * face * grid.facing[:, 0])
    s = jnp.sum(weight * face * grid.facing[:, 1])
    theta = jnp.arctan2(s, c)
    pose = jnp.stack([grid.xy[anchor, 0] + mx, grid.xy[anchor, 1] + my, theta])
    ex, ey = dx - mx, dy - my
    floor = (0.5 * gap_m) ** 2
    covariance = jnp.stack([
        jnp.sum(weight * ex**2) + floor, jnp.sum(weight * ey**2) + floor, jnp.sum(weight * ex * ey)
    ])  # fmt: skip
    total = belief.mass[0] + belief.mass[1]
    rival = jnp.max(jnp.where(is_near, 0.0, total)) / jnp.maximum(total[anchor], _TINY)
    return Reading(
        pose=compose(pose, since),
        map_index=anchor,
        here=here,
        turned=jnp.sum(other),
        off=belief.off,
        rival=rival,
        covariance=covariance,
    )


def paced(
    config: VerdictConfig, places: Places, pending: Float[Array, "3"], odometry: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Bool[Array, ""], Float[Array, "3"], Float[Array, ""]]:
    """Say whether the robot has driven far enough for a transition.

    Shorter motions are gathered: a transition in cells of one gap, done four times over a quarter
    of a gap, would spread the belief without moving it.

    Returns:
        The gathered motion, whether it is due, what is pending after this frame, and the frame's
        weight as evidence: the way into it as a share of `unit_m`, at most 1.
    """
    motion = compose(pending, odometry)
    moved = jnp.sqrt(motion[0] ** 2 + motion[1] ** 2)
    is_due = moved >= config.step_gaps * places.gap_m
    driven = jnp.sqrt(odometry[0] ** 2 + odometry[1] ** 2)
    weight = jnp.minimum(1.0, driven / places.unit_m)
    return motion, is_due, jnp.where(is_due, 0.0, motion), weight


def carried(
    config: VerdictConfig,
    places: Places,
    belief: Belief,
    motion: Float[Array, "3"],
    is_due: Bool[Array, ""],
) -> Belief:
    """Carry the belief over a gathered motion where that is due."""
    return jax.lax.cond(is_due, lambda b: predict(config, places, b, motion), lambda b: b, belief)


def carried_back(
    config: VerdictConfig,
    places: Places,
    belief: Belief,
    motion: Float[Array, "3"],
    is_due: Bool[Array, ""],
) -> Belief:
    """Carry the belief to before a gathered motion where that was due."""
    return carried(config, places, belief, inverse(motion), is_due)
