"""Where a body faces, held against where it goes: which reading of its attitude is the right one.

A robot drives along its own axis, most of the way. So the order of a quaternion's numbers, or the
unit of a heading, shows in the direction of motion; where it does not, the user is asked.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from taojax.datasets.trajectory import driven_m, spaced

__all__ = ["CLEAR_RAD", "decided", "misfit_rad"]

CLEAR_RAD = np.deg2rad(2.0)
"""A reading that is nearer than this to the direction of motion is not questioned."""

LEAST_CHORDS = 4
"""So many pieces of way are needed to say anything."""


def misfit_rad(xy: Float[np.ndarray, "n 2"], theta: Float[np.ndarray, " n"]) -> float | None:
    """Return how far headings are from the direction of motion, forwards or in reverse.

    Args:
        xy: (n, 2) positions [m] in the order driven.
        theta: (n,) headings [rad].

    Returns:
        Root of the mean square [rad] over pieces of a metre, at most pi / 2; shorter pieces where
        the whole way is short. None where the body hardly moves.
    """
    way = float(driven_m(xy)[-1])
    piece = min(1.0, way / 20.0)
    if piece < 0.02:
        return None
    at = spaced(xy, piece)
    if len(at) <= LEAST_CHORDS:
        return None
    step = np.diff(xy[at], axis=0)
    middle = np.angle(np.exp(1j * theta[at[:-1]]) + np.exp(1j * theta[at[1:]]))
    off = np.arctan2(step[:, 1], step[:, 0]) - middle
    off = np.abs((off + np.pi / 2) % np.pi - np.pi / 2)
    return float(np.sqrt(np.mean(off**2)))


def decided(misfits: Mapping[str, float | None]) -> str | None:
    """Return the reading that the direction of motion leaves, None where it says nothing.

    Args:
        misfits: reading -> what `misfit_rad` says of it.
    """
    known = sorted((value, name) for name, value in misfits.items() if value is not None)
    if len(known) < len(misfits) or len(known) < 2:
        return None
    (best, name), (second, _) = known[:2]
    is_clear = second > CLEAR_RAD and best < 0.5 * second and best < np.deg2rad(20.0)
    return name if is_clear else None
