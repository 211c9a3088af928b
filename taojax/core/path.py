"""How well one answer explains the frames around it: the trajectory-anchor cost along its path.

An answer for one frame, carried through odometry, predicts where every frame around it was. Each of
those frames has a list of its own. The listed anchor that fits a prediction best is its anchor;
the paper's closed-form fit moves the answer onto these anchors, and Eq. 1 there says how well they
agree. Counting agreements instead of costs gives a vote that no single frame can sway.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.config import VerdictConfig
from taojax.core.cost import huber
from taojax.core.procrustes import fit_se2
from taojax.core.se2 import transform

_TINY = 1e-9


class Window(eqx.Module):
    """Frames around an answer, seen from its own frame."""

    xy: Float[Array, "w 2"]
    """Their positions in the frame of the answered one [m]."""

    way_gaps: Float[Array, " w"]
    """Way driven between each and the answered frame, gaps."""

    index: Int[Array, "w c"]
    """Their candidates, -1 = none."""

    scaled: Float[Array, "w c"]
    """Similarities on the fixed scale."""

    weight: Float[Array, " w"]
    """How much each counts, non-negative; 0 outside the window."""


class Support(eqx.Module):
    """What the frames around an answer say of it."""

    cost: Float[Array, ""]
    """Mean of Eq. 1's geometric and similarity terms along the path, 0 to 1."""

    vote: Float[Array, ""]
    """Weighted share of the frames whose first candidate lies where the answer predicts them."""

    listed: Float[Array, ""]
    """The same for any candidate."""

    level: Float[Array, ""]
    """Mean similarity of the frames' first candidates, fixed scale."""

    frames: Float[Array, ""]
    """Sum of the weights."""


def _distances(
    xy_map: Float[Array, "m 2"], at: Float[Array, "w 2"], index: Int[Array, "w c"], gap_m: Array
) -> Float[Array, "w c"]:
    """Return how far each candidate lies from its frame's predicted position, gaps."""
    known = jnp.maximum(index, 0)
    dx, dy = xy_map[known, 0] - at[:, None, 0], xy_map[known, 1] - at[:, None, 1]
    return jnp.where(index >= 0, jnp.sqrt(dx**2 + dy**2) / gap_m, jnp.inf)


class Path(eqx.Module):
    """An answer's path through the map: an anchor for each frame around it."""

    pose: Float[Array, "3"]
    """The answer, moved onto its anchors by the closed-form fit."""

    anchor: Int[Array, " w"]
    """Listed anchor that fits each frame best; -1 without any candidate."""

    price: Float[Array, " w"]
    """What each frame costs: 0 to 1, the price of a frame without support."""

    relative: Float[Array, "w c"]
    """Distances of all candidates from the predicted position, in tolerances."""

    is_inlier: Bool[Array, " w"]
    """Frames whose anchor lies within the tolerance."""


def along(
    config: VerdictConfig,
    xy_map: Float[Array, "m 2"],
    gap_m: Float[Array, ""],
    pose: Float[Array, "3"],
    window: Window,
) -> Path:
    """Follow an answer through the frames around it.

    Args:
        config: tolerance, which is the Huber threshold too.
        xy_map: anchor positions [m].
        gap_m: median distance between neighbouring anchors [m].
        pose: the answer.
        window: the frames.

    Source:
        Paper, section 3.2 and Eq. 1: rho_delta of the residuals after the closed-form fit, plus
        similarity; each frame's part is capped at 1, the price of a frame without support.
    """
    tolerance = config.near_gaps + config.drift * window.way_gaps
    rows = jnp.arange(window.index.shape[0])

    def priced(pose: Array) -> tuple[Array, Array, Array]:
        distance = _distances(xy_map, transform(pose[None], window.xy), window.index, gap_m)
        relative = distance / tolerance[:, None]
        # Half of a frame's price is for distance, half for dissimilarity.
        bent = huber(jnp.minimum(relative, 1e3) ** 2, 1.0)
        price = jnp.minimum(1.0, 0.5 * bent + 0.5 * (1.0 - window.scaled))
        price = jnp.where(window.index >= 0, price, 1.0)
        return relative, price, jnp.argmin(price, axis=1)

    relative, price, chosen = priced(pose)
    is_inlier = relative[rows, chosen] <= 1.0
    anchors = xy_map[jnp.maximum(window.index[rows, chosen], 0)]
    # The answer itself is one more pair, so that a few anchors cannot carry it away.
    weight = jnp.where(is_inlier, window.weight, 0.0)
    p = jnp.concatenate([window.xy, jnp.zeros((1, 2))])
    q = jnp.concatenate([anchors, pose[None, :2]])
    fit = fit_se2(p, q, jnp.append(weight, 1.0))
    fitted = jnp.where(fit.is_degenerate, pose, fit.T_map_odom)
    relative, price, chosen = priced(fitted)
    return Path(
        fitted, window.index[rows, chosen], price[rows, chosen], relative,
        relative[rows, chosen] <= 1.0,
    )  # fmt: skip


def support(
    config: VerdictConfig,
    xy_map: Float[Array, "m 2"],
    gap_m: Float[Array, ""],
    pose: Float[Array, "3"],
    window: Window,
) -> Support:
    """Try an answer on the frames around it.

    Args:
        config: as for `along`, and so are the others.
        xy_map: anchor positions [m].
        gap_m: median distance between neighbouring anchors [m].
        pose: the answer.
        window: the frames.

    Returns:
        The figures, after the fit; all finite, also without any candidate.
    """
    path = along(config, xy_map, gap_m, pose, window)
    total = jnp.maximum(jnp.sum(window.weight), _TINY)
    share = lambda is_it: jnp.sum(jnp.where(is_it, window.weight, 0.0)) / total
    level = jnp.where(window.index[:, 0] >= 0, window.scaled[:, 0], 0.0)
    return Support(
        cost=jnp.sum(window.weight * path.price) / total,
        vote=share(path.relative[:, 0] <= 1.0),
        listed=share(jnp.any(path.relative <= 1.0, axis=1)),
        level=jnp.sum(window.weight * level) / total,
        frames=jnp.sum(window.weight),
    )
