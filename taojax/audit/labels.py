"""What the truth says of each frame, and which frames may be fitted on."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

_CELLS = 4_000_000  # distances held at once: 32 MB


def nearest_map_distance(
    query_m: Float[np.ndarray, "t 2"], map_m: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " t"]:
    """Return the distance from each query to the nearest map pose.

    Args:
        query_m: true positions, metres.
        map_m: positions of the map images, metres.

    Returns:
        Metres.
    """
    rows = max(1, _CELLS // len(map_m))
    nearest = np.empty(len(query_m))
    for start in range(0, len(query_m), rows):
        part = query_m[start : start + rows, None]
        gap = part - map_m[None]
        nearest[start : start + rows] = np.sqrt((gap**2).sum(axis=2).min(axis=1))
    return nearest


def label_frames(
    nearest_m: Float[np.ndarray, " t"], r_in_m: float, r_out_m: float
) -> Shaped[np.ndarray, " t"]:
    """Name each frame in_map, map_out or grey.

    Args:
        nearest_m: distance to the nearest map pose, metres.
        r_in_m: in-map means at most this far.
        r_out_m: map-out means farther than this; between the two lies the grey zone.
    """
    far = np.where(nearest_m > r_out_m, "map_out", "grey")
    return np.where(nearest_m <= r_in_m, "in_map", far)


@dataclasses.dataclass(frozen=True)
class _Frames:
    """Some frames of a run with their labels."""

    frame: Int[np.ndarray, " n"]
    """Row of the run."""

    label: Shaped[np.ndarray, " n"]

    signals: Mapping[str, np.ndarray]
    """Signal -> (n,)."""

    @property
    def is_in(self) -> Bool[np.ndarray, " n"]:
        """Which frames are in-map."""
        return self.label == "in_map"

    @property
    def is_out(self) -> Bool[np.ndarray, " n"]:
        """Which frames are map-out."""
        return self.label == "map_out"


@dataclasses.dataclass(frozen=True)
class CalibrationSplit(_Frames):
    """Frames that thresholds and models may be fitted on. Made by `split_frames` alone."""


@dataclasses.dataclass(frozen=True)
class TestSplit(_Frames):
    """Frames that are only scored, with all numbers frozen. Made by `split_frames` alone."""


class Splits(NamedTuple):
    """A run cut in two, with a gap between that belongs to neither."""

    name: Shaped[np.ndarray, " t"]
    """calibration, gap or test, per frame."""

    calibration: CalibrationSplit
    test: TestSplit


def split_frames(
    signals: Mapping[str, np.ndarray],
    label: Shaped[np.ndarray, " t"],
    *,
    calibration_share: float,
    gap_frames: int,
) -> Splits:
    """Cut a run into calibration, gap and test, in this order.

    Args:
        signals: signal -> (t,).
        label: in_map, map_out or grey, per frame.
        calibration_share: share of all frames, from the start.
        gap_frames: one window. No literal signal of a test frame remembers a calibration frame;
            joint ones fade over more frames, so the first of the test half are not independent of
            the calibration half. Labels never reach a signal.

    Returns:
        The two tables; a very short run may leave the test table empty.
    """
    n = len(label)
    end = int(np.floor(n * calibration_share))
    start = min(n, end + gap_frames)
    name = np.full(n, "gap", dtype="<U11")
    name[:end], name[start:] = "calibration", "test"

    def part(low: int, high: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        cut = {key: values[low:high] for key, values in signals.items()}
        return np.arange(low, high), label[low:high], cut

    return Splits(name, CalibrationSplit(*part(0, end)), TestSplit(*part(start, n)))
