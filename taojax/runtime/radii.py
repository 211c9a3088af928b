"""Which radii suit a site: how near a closure must be to help, and where the map is out of sight.

A proposal from the size of the map, so that no result can lean on it; `SITES` is the rule.
"""

import math
from typing import NamedTuple

from taojax.runtime.inspection import MapShape

__all__ = ["SITES", "Radii", "suggest_radii"]


class Site(NamedTuple):
    """A kind of place and the radii that are usual there [m]."""

    name: str
    below_m: float
    """Longer side of its map."""

    r_in_m: float
    r_out_m: float


SITES = (
    Site("rooms", 40.0, 1.5, 3.0),
    Site("a corridor or yard", 300.0, 5.0, 10.0),
    Site("a street", math.inf, 10.0, 10.0),
)

STEPS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Round numbers; times powers of ten."""

PROGRESS = 2.0, 10.0
"""In map spacings, where positions are progress along a line, as the paper has it in rows."""


class Radii(NamedTuple):
    """What to hand to `--r-in` and `--r-out` [m], and why."""

    r_in_m: float
    r_out_m: float
    why: str


def suggest_radii(shape: MapShape, stray_m: float | None = None) -> Radii:
    """Propose radii for a map.

    Args:
        shape: of the map.
        stray_m: drift of the odometry, where it is known: no closure is placed better than
            that, nor better than the map is dense.
    """
    if min(shape.size_m) == 0.0 and max(shape.size_m) > 0.0:
        r_in_m, r_out_m = (_round_up(times * shape.spacing_m) for times in PROGRESS)
        return Radii(r_in_m, r_out_m, "positions along a line: 2 and 10 map spacings")
    long_m = max(shape.size_m)
    site = next(site for site in SITES if long_m < site.below_m)
    why = f"a map of {long_m:.0f} m is taken for {site.name}"
    floors = {"the map's spacing": shape.spacing_m, "the drift of odometry": stray_m or 0.0}
    name = max(floors, key=floors.__getitem__)
    if (least_m := floors[name]) <= site.r_in_m:
        return Radii(site.r_in_m, site.r_out_m, why)
    r_in_m = _round_up(least_m)
    r_out_m = max(r_in_m, min(2.0 * r_in_m, SITES[-1].r_out_m))
    return Radii(r_in_m, r_out_m, f"{why}, raised to {name}")


def _round_up(least: float) -> float:
    """Return the next round number."""
    power = 10.0 ** math.floor(math.log10(least))
    return next((s * power for s in STEPS if s * power >= least * (1 - 1e-6)), 10.0 * power)
