"""What the true minimum of Eq. 1 changed, against the closed form on the same frames."""

from collections.abc import Callable

import numpy as np

from taojax.config import Config, replace
from taojax.runtime.frames import StreamRecord

SAME = 1e-4
"""Costs nearer than this, relatively, differ by rounding alone."""


def check_refinement(
    config: Config, refined: StreamRecord, replayed: Callable[[Config], StreamRecord]
) -> str:
    """Say how the refined literal cost stands to the closed form, for the notes of a run.

    Args:
        config: settings of the run, with refinement on.
        refined: its records.
        replayed: replays the same frames with other settings.
    """
    other = replayed(replace(config, {"refine": False}))
    closed = np.asarray(other.signals["tao_rank"], float).ravel()
    change = np.asarray(refined.signals["tao_rank"], float).ravel() - closed
    change = change / np.maximum(np.abs(closed), 1e-6)
    lower, higher = change < -SAME, change > SAME
    words = f"lower in {lower.mean():.0%} of the frames"
    if lower.any():
        words += f" (there by {-np.median(change[lower]):.2%} in the median)"
    words += ", the same in the others"
    if higher.any():
        words += f"; HIGHER in {higher.sum()} (by up to {change.max():.2%}), which is a fault"
    return (
        f"refinement is on: tao_rank is Eq. 1 at its Huber minimum; against the closed form {words}"
    )
