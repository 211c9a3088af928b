"""What a user says of how files are to be read, and what one file was found to hold."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Int

from taojax.datasets.trajectory import Trajectory

__all__ = ["PLAIN", "Angles", "Drive", "Plane", "Quaternion", "Reading", "TimeUnit"]

TimeUnit = Literal["s", "ms", "us", "ns"]
"""Unit of stamps."""

Quaternion = Literal["xyzw", "wxyz"]
"""Order of the four numbers of a quaternion."""

Angles = Literal["rad", "deg", "compass"]
"""Headings: counter-clockwise from x in radians or degrees, or degrees clockwise from y (north)."""

Plane = Literal["xz", "xy", "xz-up"]
"""Which plane 3-D poses are laid into, and which body axis looks forward there."""


@dataclass(frozen=True)
class Reading:
    """Words of the user; None: the file says it, or a line says what was assumed."""

    times: Path | None = None
    """Stamps of poses without any."""

    plane: Plane | None = None
    """How 3-D poses are laid flat."""

    topic: str | None = None
    """Of a bag."""

    time_unit: TimeUnit | None = None
    """Of stamps; files whose dates cannot be in this unit keep their own."""

    quaternion: Quaternion | None = None
    """Order of quaternions; files whose direction of motion fits the other alone keep their own."""

    angles: Angles | None = None
    """Of heading columns."""

    columns: tuple[str, ...] = ()
    """Names of the columns of text without a header, for files of so many columns."""

    decimal: Literal["point", "comma"] | None = None
    """Decimal sign of text."""

    is_shared: bool = False
    """The words are for several files: one that lies in its usual plane alone is left there."""


PLAIN = Reading()
"""Nothing was said."""


class Drive(NamedTuple):
    """What one file holds."""

    poses: Trajectory
    """In the order of time, each stamp once."""

    notes: tuple[str, ...] = ()
    """Sentences that the report must repeat."""

    has_stamps: bool = True
    """False: row numbers stand for seconds."""

    rows: Int[np.ndarray, " n"] | None = None
    """Row of the file, from 0, that each pose comes from; None: row by row."""

    n_rows: int | None = None
    """Rows of the file, where some came twice."""

    has_handedness: bool = True
    """False: from a camera's view alone, left and right could also be the other way round."""
