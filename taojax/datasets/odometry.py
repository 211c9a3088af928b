"""Relative odometry for a converted data set: from files, or simulated and said to be.

Every source becomes a drive in its own frame; the motion between two frames is read off that drive
at their stamps. So sources of any rate fit frames of any rate.
"""

import re
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from taojax.datasets.clocks import in_order, seconds
from taojax.datasets.reading import PLAIN, Drive, Reading
from taojax.datasets.rosbag import read_bag
from taojax.datasets.simulate import WorldConfig, simulated_odometry
from taojax.datasets.text_tables import read_rows, values_of
from taojax.datasets.trajectories import NUMBERED, read_trajectory, row_of, stamps_s, text_columns
from taojax.datasets.trajectory import Trajectory, every, integrate, motions, pose_at
from taojax.errors import InputError
from taojax.files.specs import fail, read_text
from taojax.files.tables import MOTION, read_table

__all__ = ["OdometryKind", "odometry_at", "read_odometry", "read_wheels", "simulated"]

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


OdometryKind = Literal[
    "tum", "kitti", "euroc", "g2o", "csv", "steps", "wheels", "bag", "robotcar-vo"
]
"""What holds the odometry; the first five as in `trajectories.Kind`."""

LEAST_COVERED = 0.5
"""Odometry that covers a smaller share of the frames belongs to another drive."""


def read_odometry(path: Path, kind: OdometryKind, reading: Reading = PLAIN) -> Drive:
    """Read odometry as a drive in its own frame.

    Args:
        path: a file; a sequence folder for `wheels`; a file or folder for `bag`.
        kind: a file of poses (see `read_trajectory`), `steps` (the contract's
            query/odometry.csv, or columns dx,dy,dtheta), `wheels` (Complex Urban counters and
            gyro), `bag` (ROS 1 or 2) or `robotcar-vo` (vo/vo.csv).
        reading: what the user says of it; kinds that are planar by themselves do not ask the plane.

    Returns:
        At least two poses.

    Raises:
        InputError: naming file, row and fix.
        MissingExtraError: a bag, and rosbags is not installed.
    """
    if reading.times is not None and kind in ("steps", "wheels", "bag", "robotcar-vo"):
        what = f"odometry of kind {kind} has its own stamps"
        raise fail(reading.times, what, "leave the times away")
    if reading.topic is not None and kind != "bag":
        raise fail(path, f"odometry of kind {kind} has no topics", "leave the topic away")
    if kind == "steps":
        return _read_steps(path, reading)
    if kind == "wheels":
        return Drive(read_wheels(path))
    if kind == "bag":
        return read_bag(path, topic=reading.topic, plane=reading.plane or "xy")
    if kind == "robotcar-vo":
        return Drive(_read_robotcar_vo(path))
    return read_trajectory(path, kind, reading)


def odometry_at(
    source: Trajectory, t_s: Float[np.ndarray, " t"], gate_s: float, name: str = "odometry"
) -> tuple[Float[np.ndarray, "t 3"], str | None]:
    """Read the motion between frames off a drive.

    Args:
        source: the drive, in any frame.
        t_s: (T,) stamps of the frames on the same clock, rising.
        gate_s: a frame farther than this from every pose of the drive is not covered by it.
        name: where the drive comes from, for messages.

    Returns:
        (T, 3) forward [m], left [m], yaw [rad] since the frame before, row 0 zero; and a sentence
        for the report where frames are not covered (they have the pose nearest in time, so that
        the robot seems to wait there), else None.

    Raises:
        InputError: less than half of the frames are covered; it names the share, both ranges of
            time and the unit that would explain it.
    """
    poses, is_covered = pose_at(source, t_s, gate_s)
    share, n_out = float(is_covered.mean()), int((~is_covered).sum())
    if share < LEAST_COVERED:
        raise InputError(
            f"{name}: odometry covers {share:.0%} of the {len(t_s)} frames within {gate_s:g} s: "
            f"frames run from {t_s[0]:.3f} to {t_s[-1]:.3f} s, odometry from "
            f"{source.t_s[0]:.3f} to {source.t_s[-1]:.3f} s; {_clock_fix(source.t_s, t_s)}"
        )
    note = None
    if n_out:
        note = (
            f"odometry: {n_out} of {len(t_s)} frames are more than {gate_s:g} s from any of its "
            "poses and have the nearest one, so that the robot seems to wait there"
        )
    return motions(poses), note


def simulated(xyt: Float[np.ndarray, "t 3"], seed: int) -> tuple[Float[np.ndarray, "t 3"], str]:
    """Simulate odometry from poses, for a data set that has none.

    Args:
        xyt: (T, 3) poses of the frames.
        seed: of the noise.

    Returns:
        (T, 3) forward [m], left [m], yaw [rad], row 0 zero; and the sentence for the report.

    Raises:
        InputError: the seed is negative.
    """
    if seed < 0:
        raise InputError(f"seed {seed}: must not be negative")
    knobs = WorldConfig()
    note = (
        f"simulated odometry: true motions with a scale error of {knobs.odometry_scale:.1%}, a yaw "
        f"error of {knobs.odometry_yaw_rad_per_m:g} rad per metre and white noise of "
        f"{knobs.odometry_m:g} m and {knobs.odometry_rad:g} rad per root of a metre, seed {seed}"
    )
    return simulated_odometry(xyt, knobs, seed), note


def _clock_fix(source_s: np.ndarray, t_s: np.ndarray) -> str:
    """Say what would bring two clocks together: a unit, a shift or a wider gate."""
    # A slip of unit shows in how long the drives last and in how late they are, alike.
    powers = {
        round(np.log10(own / other) / 3.0) if own > 0 and other > 0 else 0
        for own, other in (
            (np.ptp(source_s), np.ptp(t_s)),
            (np.median(np.abs(source_s)), np.median(np.abs(t_s))),
        )
    }
    power = powers.pop() if len(powers) == 1 else 0
    if power:
        larger = "odometry" if power > 0 else "frames"
        large = f"the stamps of the {larger} look 1e{3 * abs(power)} times too large: use seconds"
        return f"{large}, or add --time-unit"
    if source_s[0] <= t_s[-1] and t_s[0] <= source_s[-1]:
        return "use denser odometry, a wider gate, or odometry of the whole drive"
    guess = f"add --clock-offset {t_s[0] - source_s[0]:.6f} if both start together"
    return f"give both the same clock, and odometry of the same drive; {guess}"


def _read_steps(path: Path, reading: Reading) -> Drive:
    """Chain motions, after late rows are put in their place and repeated ones left out."""
    table = read_rows(path, reading.decimal)
    found = text_columns(path, table, "steps", reading)
    if missing := [name for name in MOTION if name not in found.columns]:
        what = f"row {table.lines[0]}: no column {missing[0]}"
        raise fail(path, what, "steps are dx,dy,dtheta; poses need --odometry-kind poses")
    notes = [*table.notes, *([f"{path.name}: {found.said}"] if found.said else [])]
    moved, unit = [], None
    for role in MOTION:
        values, unit = values_of(path, table, role, found.columns[role])
        moved.append(values)
    steps, n = np.stack(moved, axis=1), len(table.lines)
    if n < 2:
        raise fail(path, f"{n} data row(s)", "at least 2 are needed")
    if unit == "deg":
        notes.append(f"{path.name}: column {found.columns[MOTION[2]][0].name} is in degrees")
    if "t_s" not in found.columns:
        drive = Trajectory(np.arange(float(n)), integrate(steps))
        return Drive(drive, (*notes, NUMBERED), False)
    raw, unit = values_of(path, table, "t_s", found.columns["t_s"])
    where = lambda index: f"row {table.lines[index]}"
    step_m = np.hypot(*steps[1:, :2].T)
    t_s, assumed = seconds(path, raw, step_m, unit or found.unit, reading.time_unit, where)
    order = in_order(path, t_s, steps, where, is_motion=True)
    drive = Trajectory(t_s[order.rows], integrate(steps[order.rows]))
    return Drive(drive, (*notes, *assumed, *order.notes), True, order.rows, n)


def _read_robotcar_vo(path: Path) -> Trajectory:
    """Chain relative poses, each from its earlier to its later stamp, in either order of rows.

    Source:
        Maddern et al., IJRR 36(1), 2017: x forward, y right, z down. The data set's own code takes
        a row's pose as the motion up to its source stamp, which is the later one.
    """
    table = read_table(path, "robotcar_vo")
    n = len(table["x"])
    rows = np.arange(n)
    where = lambda index: row_of(path, n, int(rows[index]))
    stamps = np.stack([table["source_timestamp"], table["destination_timestamp"]], axis=1)
    step_us = stamps[:, 0] - stamps[:, 1]
    is_odd = (step_us == 0) | (np.sign(step_us) != np.sign(step_us[0]))
    if (odd := np.flatnonzero(is_odd)).size:
        what = f"{where(int(odd[0]))}: its two stamps are the same, or in another order than before"
        raise fail(path, what, "every row joins two stamps, the later one always in one column")
    motion = np.stack([table["x"], -table["y"], -table["yaw"]], axis=1)
    if stamps[0, 0] > stamps[-1, 0]:
        stamps, motion, rows = stamps[::-1], motion[::-1], rows[::-1]
    before, behind = stamps.min(axis=1), stamps.max(axis=1)
    if (odd := np.flatnonzero(before[1:] != behind[:-1])).size:
        at = int(odd[0])
        what = f"{where(at + 1)}: begins at {before[at + 1]}, but {where(at)} ends at {behind[at]}"
        raise fail(path, what, "the rows must chain in time: sort them, or cut the file there")
    if motion[:, 0].sum() < -1.0:
        what = f"the motions lead {-motion[:, 0].sum():.0f} m backwards in all"
        raise fail(path, what, "the poses look inverted: give those of the later stamp")
    every_us = np.concatenate([before[:1], behind])
    t_s = stamps_s(path, every_us, "microseconds", lambda index: where(max(index - 1, 0)))
    return Trajectory(t_s, integrate(np.concatenate([np.zeros((1, 3)), motion])))
