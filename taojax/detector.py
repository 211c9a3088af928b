"""The frozen numbers of a calibrated detector: fitted by the judge, carried to run time in a file.

A linear model of the log odds of being off the map, over sealed signals. Each frame is judged from
its own row; memory is in the signals.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.errors import InputError
from taojax.specs import column_names, read_text

LARGEST_LOG_ODDS = 30.0
"""Keeps probabilities inside (0, 1) in float64."""

LIST_RECALL = 0.75
"""Recall of retrieval lists without map descriptors, and of a run that does not say: neither blind
nor sure."""


class MapFacts(NamedTuple):
    """Which map a detector was fitted on, told by what both sides can measure."""

    poses_sha256: str
    """Of map/poses.csv."""

    views_sha256: str
    """Of the map's descriptors; blank where the frontend gives lists."""

    spacing_m: float
    """Median distance between neighbours."""

    recall: float
    """Share of map images whose most similar other image lies nearby."""


class Detector(NamedTuple):
    """Everything that `probability` needs."""

    columns: tuple[str, ...]
    """Signals it reads."""

    mean: Float[np.ndarray, " f"]
    """Of each signal over the in-map calibration frames, over all where none is: what its term is
    measured from."""

    scale: Float[np.ndarray, " f"]
    weight: Float[np.ndarray, " f"]
    """Log odds per standardised signal."""

    bias: float
    threshold: float
    """Frames with a probability above it are rejected; NaN = nothing can be decided."""

    note: str
    """How it was fitted, in words."""

    fitted_on: MapFacts | None = None
    """None where the run did not say."""


def log_odds_terms(
    detector: Detector, signals: Mapping[str, np.ndarray]
) -> Float[np.ndarray, "t f"]:
    """Return what each signal adds to the log odds of each frame above the mean in-map frame's."""
    table = np.stack([np.asarray(signals[name], float) for name in detector.columns], axis=1)
    return (table - detector.mean[None]) / detector.scale[None] * detector.weight[None]


def probability(detector: Detector, signals: Mapping[str, np.ndarray]) -> Float[np.ndarray, " t"]:
    """Return the probability of being off the map, frame by frame; no frame sees another.

    Args:
        detector: fitted numbers.
        signals: column -> (t,).
    """
    # Summed by hand: a matrix product may round differently for other numbers of frames.
    log_odds = np.sum(log_odds_terms(detector, signals), axis=1) + detector.bias
    return 1.0 / (1.0 + np.exp(-np.clip(log_odds, -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)))


def foreign_map(detector: Detector, here: MapFacts | None) -> str | None:
    """Say so where a detector was fitted on another map than the one at hand.

    Args:
        detector: frozen numbers.
        here: the map that it is about to judge; None = unknown.

    Returns:
        One sentence; None where the map is the same, or nobody knows.
    """
    then = detector.fitted_on
    if then is None or here is None or then[:2] == here[:2]:
        return None
    is_same = then.poses_sha256 == here.poses_sha256
    what = "other descriptors of this map" if is_same else "another map"
    told = lambda facts: f"spacing {facts.spacing_m:.3g} m and recall {facts.recall:.2f}"
    return (
        f"the calibration was fitted on {what} ({told(then)}; here {told(here)}): how many wrong"
        " frames its threshold accepts here is unknown until this place is audited"
    )


def to_toml(detector: Detector) -> str:
    """Return the text of a calibration file."""
    lines = [
        "# Written by `taojax evaluate`; read by `taojax score --calibration FILE`.",
        "columns = [" + ", ".join(f'"{name}"' for name in detector.columns) + "]",
    ]
    for name in ("mean", "scale", "weight"):
        values = ", ".join(repr(float(value)) for value in getattr(detector, name))
        lines.append(f"{name} = [{values}]")
    lines += [f"bias = {float(detector.bias)!r}", f"threshold = {float(detector.threshold)!r}"]
    note = detector.note.replace("\\", "/").replace('"', "'")
    lines.append(f'note = "{note}"')
    if (facts := detector.fitted_on) is not None:
        lines += [
            "",
            "[map]",
            f'poses_sha256 = "{facts.poses_sha256}"',
            f'views_sha256 = "{facts.views_sha256}"',
            f"spacing_m = {float(facts.spacing_m)!r}",
            f"recall = {float(facts.recall)!r}",
        ]
    return "\n".join(lines) + "\n"


def from_toml(path: Path) -> Detector:
    """Read a calibration file.

    Raises:
        InputError: unreadable, or its numbers do not fit together.
    """
    fix = "use the calibration.toml of a run made by `taojax audit`"
    try:
        tree = tomllib.loads(read_text(path))
        columns = tuple(tree["columns"])
        vectors = [np.array(tree[name], float) for name in ("mean", "scale", "weight")]
        bias, threshold = float(tree["bias"]), float(tree["threshold"])
        note, seen = str(tree["note"]), tree.get("map")
        fitted_on = None
        if seen is not None:
            fitted_on = MapFacts(
                str(seen["poses_sha256"]),
                str(seen["views_sha256"]),
                float(seen["spacing_m"]),
                float(seen["recall"]),
            )
    except (KeyError, TypeError, ValueError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: is not a calibration file ({error}); {fix}") from error
    unknown = sorted(set(columns) - set(column_names("signals")))
    if unknown:
        raise InputError(f"{path}: unknown signal {unknown[0]!r}; {fix}")
    numbers = np.concatenate([*(vector.ravel() for vector in vectors), [bias]])
    fits = all(vector.shape == (len(columns),) for vector in vectors)
    if not fits or not np.isfinite(numbers).all() or not (vectors[1] > 0).all():
        raise InputError(f"{path}: mean, scale and weight do not fit the columns; {fix}")
    return Detector(columns, vectors[0], vectors[1], vectors[2], bias, threshold, note, fitted_on)
