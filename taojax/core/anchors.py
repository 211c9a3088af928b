"""The static map, prepared for look-ups: which anchor is near, and which near one a list names."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from taojax.core.cost import huber


class AnchorGrid(eqx.Module):
    """The static map, prepared for look-ups."""

    xy: Float[Array, "m 2"]
    """Anchor positions, map frame [m]."""

    theta: Float[Array, " m"]
    """Anchor headings [rad]."""

    facing: Float[Array, "m 2"]
    """The same as unit vectors."""

    nearest: Int[Array, " cells"]
    """Row-major grid: the anchor nearest to a cell's centre, -1 where none is in reach."""

    shape: Int[Array, "2"]
    """Cells along x and y."""

    corner: Float[Array, "2"]
    """Lower corner of the grid, map frame [m]."""

    cell_m: Float[Array, ""]
    """Edge of a cell [m]."""

    neighbour: Int[Array, "b m"]
    """Each anchor's nearest anchors, itself first; a row is read whole, so it lies in one piece."""

    neighbour_m2: Float[Array, "b m"]
    """Their squared distances [m^2]."""


def pool(
    grid: AnchorGrid,
    gamma: float | Float[Array, ""],
    delta_m: float | Float[Array, ""],
    index: Int[Array, " c"],
    similarity: Float[Array, " c"],
) -> UInt[Array, " m"]:
    """Name the best anchor in every anchor's neighbourhood, for one frame.

    Args:
        grid: the map.
        gamma: weight of similarity.
        delta_m: Huber threshold [m].
        index: `(c,)` anchors that the frame's list names, -1 = none.
        similarity: `(c,)` theirs on the fixed scale.

    Returns:
        `(m,)` places in the list of the anchors that minimise neighbour distance cost +
        gamma (1 - s); c where that is the anchor itself, unlisted. A place fits in a byte where an
        anchor needs four, and the stream remembers many of these rows.
    """
    m, c = grid.xy.shape[0], index.shape[0]
    listed = jnp.where(index >= 0, index, m)
    place = jnp.full(m, c).at[listed].set(jnp.arange(c), mode="drop")
    row = jnp.append(similarity, 0.0)[place]
    # Neighbour by neighbour: an argmin over a gathered (m, b) array takes three times as long.
    best, least = grid.neighbour[0], jnp.inf
    for b in range(grid.neighbour.shape[0]):
        other = grid.neighbour[b]
        cost = huber(grid.neighbour_m2[b], delta_m) / delta_m**2 + gamma * (1.0 - row[other])
        best = jnp.where(cost < least, other, best)
        least = jnp.minimum(cost, least)
    return place[best].astype(np.min_scalar_type(c))


def look_up(grid: AnchorGrid, xy: Float[Array, "*n 2"]) -> Int[Array, "*n"]:
    """Return the anchor nearest to each position, -1 where none is in reach."""
    x = jnp.floor((xy[..., 0] - grid.corner[0]) / grid.cell_m)
    y = jnp.floor((xy[..., 1] - grid.corner[1]) / grid.cell_m)
    width, height = grid.shape[0].astype(xy.dtype), grid.shape[1].astype(xy.dtype)
    is_on = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    # Clip before the cast: a float beyond int32 has no defined integer.
    column = jnp.where(is_on, x, 0.0).astype(jnp.int32)
    row = jnp.where(is_on, y, 0.0).astype(jnp.int32)
    return jnp.where(is_on, grid.nearest[column * grid.shape[1] + row], -1)
