"""The static map, prepared for look-ups: which anchor is near."""

import equinox as eqx
import jax
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

    nearest: Int[Array, "n cells"]
    """Row-major grid: the anchors that may be the nearest one to a position in a cell, -1 where
    there are fewer or none is in reach."""

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


def look_up(
    grid: AnchorGrid, x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> tuple[Int[Array, "*n"], Float[Array, "*n"]]:
    """Return the anchor nearest to each position, and its squared distance [m^2].

    Args:
        grid: the map.
        x: positions [m].
        y: the same.

    Returns:
        Anchors, and distances that are infinite where none is in reach. What is nearest to a
        position does not depend on how the map lies in its frame: verdicts must not.
    """
    column = jnp.floor((x - grid.corner[0]) / grid.cell_m)
    row = jnp.floor((y - grid.corner[1]) / grid.cell_m)
    width, height = grid.shape[0].astype(x.dtype), grid.shape[1].astype(x.dtype)
    is_on = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    # Clip before the cast: a float beyond int32 has no defined integer.
    cell = jnp.where(is_on, column, 0.0).astype(jnp.int32) * grid.shape[1]
    cell += jnp.where(is_on, row, 0.0).astype(jnp.int32)
    # Coordinates are gathered one by one: pairs of them take ten times as long on a CPU. A loop,
    # because XLA takes long to compile what is written out.
    map_x, map_y = grid.xy[:, 0], grid.xy[:, 1]

    def closer(best: tuple[Array, Array], listed: Array) -> tuple[tuple[Array, Array], None]:
        other = listed[cell]
        known = jnp.maximum(other, 0)
        away = jnp.where(other >= 0, (map_x[known] - x) ** 2 + (map_y[known] - y) ** 2, jnp.inf)
        is_closer = away < best[1]
        return (jnp.where(is_closer, known, best[0]), jnp.minimum(away, best[1])), None

    none = jnp.zeros(x.shape, jnp.int32), jnp.full(x.shape, jnp.inf, x.dtype)
    anchor, away = jax.lax.scan(closer, none, grid.nearest)[0]
    return anchor, jnp.where(is_on, away, jnp.inf)
