"""What goes into a step and what comes out of it."""

from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

STATUSES = ("warming_up", "ok", "degenerate", "no_candidates", "lost")
WARMING_UP, OK, DEGENERATE, NO_CANDIDATES, LOST = range(5)


class Frame(eqx.Module):
    """What the robot knows at one instant. There is no field for the truth."""

    odometry: Float[Array, "*t 3"]
    """Motion from the frame before, in its body axes: forward [m], left [m], yaw [rad]."""

    index: Int[Array, "*t c"]
    """Retrieved map rows, best first, -1 = no candidate."""

    similarity: Float[Array, "*t c"]
    """Their similarities, at most 1."""


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
    """The newest frame's anchor on the best branch, -1 without a pose."""

    pose: Float[Array, "*t 3"]
    """The robot on the best branch; zero without a pose."""

    has_pose: Bool[Array, "*t"]
    signals: Signals
