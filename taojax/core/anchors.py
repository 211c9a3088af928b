"""The static map, prepared for look-ups: which anchor is near."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


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
