"""What goes into a step and what comes out of it."""

from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from taojax.errors import InputError

STATUSES = ("warming_up", "ok", "degenerate", "no_candidates")
WARMING_UP, OK, DEGENERATE, NO_CANDIDATES = range(4)


class Frame(eqx.Module):
    """What the robot knows at one instant. There is no field for the truth."""

    odometry: Float[Array, "*t 3"]
    """Motion from the frame before, in its body axes: forward [m], left [m], yaw [rad]."""

    index: Int[Array, "*t c"]
    """Retrieved map rows, best first, -1 = no candidate. Rows that the map lacks are none."""

    similarity: Float[Array, "*t c"]
    """Their similarities, at most 1."""

    weight: Float[Array, "*t"] | None = None
    """The frame's w_i in Eq. 1, >= 0, relative to the others of its window; all alike when left
    out. NaN and negative ones count as 0. The filter weighs frames by the way driven."""


def check_frame(frame: Frame, axes: int = 0) -> None:
    """Refuse a frame that no step can take; shapes and types alone, so traced frames will do.

    Args:
        frame: one observation, or a log of them.
        axes: leading axes, 1 for a log.

    Raises:
        InputError: which array is wrong, what is expected and what was given; one line.
    """
    lead, c = "T, " * axes, getattr(frame.similarity, "shape", ())[-1:]
    start = getattr(frame.odometry, "shape", ())[:axes]
    wanted = {
        "odometry": (f"({lead}3)", (3,), jnp.floating),
        "index": (f"({lead}C)", c, jnp.integer),
        "similarity": (f"({lead}C)", c, jnp.floating),
        "weight": (f"({lead.rstrip(' ')})", (), jnp.floating),
    }
    for name, (words, shape, kind) in wanted.items():
        if name == "weight" and frame.weight is None:
            continue
        leaf: Any = getattr(frame, name)
        got = f"{leaf.dtype} {leaf.shape}" if hasattr(leaf, "dtype") else type(leaf).__name__
        is_right = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, kind)
        if not is_right or leaf.shape != (*start, *shape) or len(start) != axes:
            what = "whole numbers" if kind is jnp.integer else "floats"
            said = f"frame.{name}: expected {what} of shape {words}, got {got}"
            others = ("odometry",) * axes + ("similarity",) * (name == "index")
            beside = [f"{o} {getattr(getattr(frame, o), 'shape', ())}" for o in others if o != name]
            raise InputError(said + (f" beside {' and '.join(beside)}" if beside else ""))


class Signals(eqx.Module, Mapping[str, Array]):
    """Column of data_specs/signals.toml -> value; always finite.

    One array holds them all: every array that leaves a compiled call costs microseconds.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    table: Float[Array, "*t s"]

    def __getitem__(self, name: str) -> Any:
        """Return one column, `(*t)`; NumPy where the table is."""
        if name not in self.names:
            raise KeyError(name)
        return self.table[..., self.names.index(name)]

    def __iter__(self) -> Iterator[str]:
        """Go through the names."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self.names)


class StreamRecord(eqx.Module):
    """One row of the signal table."""

    status: Int[Array, "*t"]
    """Position in `STATUSES`."""

    map_index: Int[Array, "*t"]
    """The anchor of the newest frame, -1 without a pose."""

    pose: Float[Array, "*t 3"]
    """Where the robot is; zero without a pose."""

    has_pose: Bool[Array, "*t"]
    signals: Signals
