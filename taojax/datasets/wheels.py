"""Wheel counters and a yaw gyro, as in KAIST Complex Urban, to a drive.

The distance is the mean of both wheels', the turn is the gyro's: wheels slip in turns, a gyro does
not. What the wheels see of the turns tells whether the gyro has the sign and unit of the format.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from taojax.datasets.trajectories import row_of, stamps_s
from taojax.datasets.trajectory import Trajectory, every, integrate
from taojax.specs import fail, read_text
from taojax.tables import read_table

__all__ = ["read_wheels"]

PARAMETERS = "calibration/EncoderParameter.txt"
"""Where the calibration lies in a sequence folder."""

FASTEST_MPS = 100.0
"""Wheels that turn faster say that a counter was reset or wrapped."""

TURN_RAD = 1.0
"""The wheels must turn so far in all before they can judge the gyro."""

AGREEMENT = (0.5, 2.0)
"""Gyro turn per wheel turn that is taken for the same turn."""

# Line, least and largest value: a diameter in millimetres is outside.
_LINES = {
    "Encoder resolution": (1.0, 1e7),
    "Encoder left wheel diameter": (0.01, 5.0),
    "Encoder right wheel diameter": (0.01, 5.0),
    "Encoder wheel base": (0.05, 10.0),
}


def read_wheels(folder: Path) -> Trajectory:
    """Dead-reckon a Complex Urban sequence.

    Args:
        folder: holds sensor_data/encoder.csv, sensor_data/fog.csv and
            calibration/EncoderParameter.txt (resolution in counts per turn, diameters and base in
            metres).

    Returns:
        A pose at every stamp of the encoder that the gyro covers, in the frame of the first.

    Raises:
        InputError: naming file, row and fix: a file or a parameter is missing, stamps are in
            another unit or do not overlap, a counter jumps, or the gyro turns otherwise than the
            wheels.
    """
    counts_per_turn, left_m, right_m, base_m = _parameters(folder / PARAMETERS)
    path, gyro = folder / "sensor_data/encoder.csv", folder / "sensor_data/fog.csv"
    encoder, fog = read_table(path, "encoder"), read_table(gyro, "fog")
    where = partial(row_of, path, len(encoder["left"]))
    t_s = stamps_s(path, encoder["stamp_ns"], "nanoseconds", where)
    gyro_s = stamps_s(
        gyro, fog["stamp_ns"], "nanoseconds", partial(row_of, gyro, len(fog["d_yaw"]))
    )
    per_count = np.pi * np.array([[left_m, right_m]]) / counts_per_turn
    way_m = np.stack([encoder["left"], encoder["right"]], axis=1) * per_count
    speed = np.abs(np.diff(way_m, axis=0)).max(axis=1) * 1e9
    speed /= np.diff(encoder["stamp_ns"])
    if (odd := np.flatnonzero(speed > FASTEST_MPS)).size:
        what = f"{where(int(odd[0]) + 1)}: a wheel runs at {speed[odd[0]]:.0f} m/s"
        raise fail(path, what, "a counter was reset or wrapped there: cut the recording")
    is_covered = (t_s >= gyro_s[0]) & (t_s <= gyro_s[-1])
    if is_covered.mean() < 0.5 or is_covered.sum() < 2:
        what = f"covers {is_covered.mean():.0%} of {path.name}"
        ranges = f"{gyro_s[0]:.3f} to {gyro_s[-1]:.3f} s, {t_s[0]:.3f} to {t_s[-1]:.3f} s"
        raise fail(gyro, f"{what} ({ranges})", "take both from one recording")
    t_s, way_m = t_s[is_covered], way_m[is_covered]
    yaw = np.interp(t_s, gyro_s, np.cumsum(fog["d_yaw"]))
    _check_gyro(gyro, yaw, (way_m[:, 1] - way_m[:, 0]) / base_m)
    return Trajectory(t_s, integrate(_arcs(way_m.mean(axis=1), yaw)))


def _arcs(way_m: Float[np.ndarray, " n"], yaw: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the motion of a body that drives a circle's arc between stamps; row 0 is zero."""
    moved, turned = np.diff(way_m, prepend=way_m[0]), np.diff(yaw, prepend=yaw[0])
    chord = moved * np.sinc(turned / (2.0 * np.pi))
    return np.stack([chord * np.cos(turned / 2), chord * np.sin(turned / 2), turned], axis=1)


def _check_gyro(path: Path, gyro: np.ndarray, wheels: np.ndarray) -> None:
    """Hold the turns of the gyro against those of the wheels, over stretches of a second or so."""
    knots = every(len(gyro), max(len(gyro) // 100, 10))
    seen, wanted = np.diff(gyro[knots]), np.diff(wheels[knots])
    if np.abs(wanted).sum() < TURN_RAD:
        return
    ratio = float((seen * wanted).sum() / (wanted**2).sum())
    if AGREEMENT[0] <= ratio <= AGREEMENT[1]:
        return
    fix = "check that d_yaw is the fourth column and the counters are left, right"
    if AGREEMENT[0] <= -ratio <= AGREEMENT[1]:
        fix = "negate d_yaw, or swap the columns left and right"
    elif AGREEMENT[0] <= abs(ratio) * np.pi / 180.0 <= AGREEMENT[1]:
        fix = "d_yaw looks like degrees: store radians"
    raise fail(path, f"the gyro turns {ratio:.3g} times as far as the wheels", fix)


def _parameters(path: Path) -> list[float]:
    """Read counts per turn, left and right diameter [m] and wheel base [m]."""
    form = ", ".join(f"'{name}: ...'" for name in _LINES)
    if not path.is_file():
        what = "no such file, so the wheels' resolution, diameters and base are unknown"
        raise fail(path, what, f"put the data set's calibration there, or a text of lines {form}")
    text, values = read_text(path), []
    for name, (low, high) in _LINES.items():
        words = r"\s*".join(name.split()[1:])
        found = re.search(rf"(?im)\b{words}\b[^\d\n+-]*([-+]?[\d.]+(?:e[-+]?\d+)?)", text)
        if found is None:
            raise fail(path, f"lacks the parameter '{name}'", f"add a line '{name}: ...'")
        row = f"row {text[: found.start()].count(chr(10)) + 1}"
        try:
            value = float(found[1])
        except ValueError as error:
            raise fail(path, f"{row}: {found[1]!r} is not a number", "fix the line") from error
        if not low <= value <= high:
            what = f"{row}: '{name}' is {value:g}, outside [{low:g}, {high:g}]"
            raise fail(path, what, "store counts per turn and metres")
        values.append(value)
    return values
