"""Stamps as they come: their unit, late and repeated rows, and two clocks that are apart."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from taojax.datasets.trajectory import driven_m, wrap
from taojax.files.specs import fail

__all__ = ["FASTEST_S", "PER_S", "Ordered", "in_order", "offset_of", "seconds"]

PER_S: dict[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}

WORDS: dict[str, str] = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
}

FASTEST_S = 5e-4
"""No sensor here stamps faster; closer stamps are in another unit."""

DATES = 3e8, 4.2e9
"""UNIX times from 1979 to 2103 [s]."""

SLOWEST_MPS, FASTEST_MPS = 0.05, 50.0
"""Robots and cars drive between these; the quotient is a thousand, so that one unit fits."""

STANDING_MPS = 0.01
"""What drives slower has stamps in another unit."""

SHORT_STEP, LONG_STEP = 2.0, 10.0
"""Steps shorter than this many units may well be seconds, or rows: of what hardly moves, of all."""

PIECE_M = 0.25
"""Speed is measured over pieces of way at least this long."""

LATE_ROWS, LATE_S = 10, 1.0
"""Messages come late by so many steps or seconds; what is later is another recording."""

SAME_M, SAME_RAD = 0.05, 0.02
"""Poses of one stamp that are nearer than this are one pose."""

Where = Callable[[int], str]
"""Names the row that a stamp comes from."""


def _speed(t: np.ndarray, step_m: np.ndarray) -> float | None:
    """Return the usual speed while moving, metres per unit; None where nothing moves."""
    way = np.concatenate([[0.0], np.cumsum(step_m)])
    if len(way) != len(t) or way[-1] < PIECE_M:
        return None
    at = np.unique(np.searchsorted(way, np.arange(0.0, way[-1], max(PIECE_M, way[-1] / 500))))
    dt = np.diff(t[at]).astype(float)
    return float(np.median(np.diff(way[at])[dt > 0] / dt[dt > 0])) if (dt > 0).any() else None


def seconds(
    path: Path,
    t: Shaped[np.ndarray, " n"],
    step_m: Float[np.ndarray, " m"],
    said: str | None,
    flag: str | None,
    where: Where,
) -> tuple[Float[np.ndarray, " n"], tuple[str, ...]]:
    """Turn stamps of any unit into seconds.

    Args:
        path: where they come from.
        t: (n,) stamps; whole ones keep all their digits.
        step_m: (n - 1,) metres driven between them.
        said: the unit that the file's format or header names.
        flag: the unit that the user names.
        where: names a row.

    Returns:
        (n,) seconds, and what was assumed.

    Raises:
        InputError: no unit fits, or two do; it names the flag that decides.
    """
    _check_alike(path, t, where)
    rising = np.diff(t).astype(float)
    step = float(np.median(rising[rising > 0])) if (rising > 0).any() else 0.0
    unit, said_why = _unit(path, t, step, _speed(t, step_m), (said, flag), where)
    why = [f"{path.name}: {said_why}"] if said_why else []
    if flag not in (None, unit):
        why = [f"{path.name}: stamps are {WORDS[unit]}, they cannot be {WORDS[flag]}"]
    return t / PER_S[unit], tuple(why)


def _unit(
    path: Path, t: np.ndarray, step: float, speed: float | None,
    words: tuple[str | None, str | None], where: Where,
) -> tuple[str, str]:  # fmt: skip
    """Return the unit of stamps and, where it is news, how it was found."""
    said, flag = words
    middle = float(np.abs(np.median(t)))
    may_be = [u for u, per in PER_S.items() if middle / per < 1e11]
    could = [u for u in may_be if step / PER_S[u] >= FASTEST_S or step == 0.0]
    drives = [u for u in could if speed is None or SLOWEST_MPS / 10 < speed * PER_S[u] < 150.0]
    dates = [u for u in could if DATES[0] <= middle / PER_S[u] < DATES[1]]
    date = next((u for u in dates if u in drives or len(could) == 1), None)
    if (
        flag is not None
        and flag in could
        and date in (None, flag, "s")
        and (date != "s" or flag in drives)
    ):
        return flag, "" if flag == "s" else f"stamps are {WORDS[flag]}, as you say"
    if date is not None:
        return date, "" if date == (said or "s") else f"stamps are recognised as {WORDS[date]}"
    if said not in (None, "s") and said in could:
        return said, ""
    fits = [u for u in could if speed is None or SLOWEST_MPS <= speed * PER_S[u] < FASTEST_MPS]
    is_standing = speed is not None and speed < STANDING_MPS and step >= SHORT_STEP
    is_slow = speed is not None and speed < SLOWEST_MPS and step >= LONG_STEP
    if said in (None, "s") and "s" in could and not is_standing and (said == "s" or not is_slow):
        return "s", ""
    if len(fits) == 1 and speed is not None and (is_standing or "s" not in could):
        how = f"by steps of {step:g} and {speed * PER_S[fits[0]]:.2g} m/s"
        return fits[0], f"stamps are recognised as {WORDS[fits[0]]}, {how}"
    if said in (None, "s") and "s" in could and not fits:
        return "s", ""
    units = " or ".join(WORDS[u] for u in (could or PER_S))
    what = f"{where(0)}: stamp {t[0]:.16g} with steps of {step:g} may be {units}"
    raise fail(path, what, "add --time-unit s, ms, us or ns")


def _check_alike(path: Path, t: np.ndarray, where: Where) -> None:
    """Refuse a stamp in another unit than the others, or in none."""
    middle = float(np.abs(np.median(t)))
    if middle < DATES[0] or not np.ptp(t):
        return
    size = np.abs(t).astype(float) / middle
    if (odd := np.flatnonzero(size > 100.0)).size:
        at = int(odd[0])
        what = (
            f"{where(at)}: stamp {t[at]:.16g} is not of the unit of the others, near {middle:.16g}"
        )
        raise fail(path, what, "bring all stamps to one unit")


class Ordered(NamedTuple):
    """Rows in the order of time, each stamp once."""

    rows: Int[np.ndarray, " k"]
    """Of the file, from 0."""

    notes: tuple[str, ...]


def in_order(
    path: Path, t_s: Float[np.ndarray, " n"], xyt: Float[np.ndarray, "n 3"], where: Where,
    *, is_motion: bool = False,
) -> Ordered:  # fmt: skip
    """Put late rows in their place and keep the first of repeated ones.

    Args:
        path: where they come from.
        t_s: (n,) stamps [s].
        xyt: (n, 3) pose of each row, or motion since the row before.
        where: names a row.
        is_motion: motions, not poses.

    Raises:
        InputError: the clock runs backwards for long, or one stamp has two poses.
    """
    order = np.argsort(t_s, kind="stable")
    notes: tuple[str, ...] = ()
    if (late := np.flatnonzero(t_s < np.maximum.accumulate(t_s))).size:
        _check_late(path, t_s, xyt, where, order, is_motion=is_motion)
        said = f"{path.name}: {_rows(len(late), 'came', 'late')}, first {where(int(late[0]))};"
        notes = (f"{said} sorted by time",)
    sorted_s, poses = t_s[order], xyt[order]
    is_twice = np.concatenate([[False], sorted_s[1:] == sorted_s[:-1]])
    if not is_twice.any():
        return Ordered(order, notes)
    first = np.maximum.accumulate(np.where(is_twice, 0, np.arange(len(order))))
    off_m = np.hypot(*(poses[:, :2] - poses[first, :2]).T)
    off_rad = np.abs(wrap(poses[:, 2] - poses[first, 2]))
    if (odd := np.flatnonzero((off_m > SAME_M) | (off_rad > SAME_RAD))).size:
        at = int(odd[0])
        other, own = sorted((int(order[at]), int(order[first[at]])), reverse=True)
        what = (
            f"{where(other)}: the stamp of {where(own)} with another pose, {off_m[at]:.2f} m away"
        )
        raise fail(path, what, "keep one row per stamp")
    at = int(order[np.flatnonzero(is_twice)[0]])
    n = int(is_twice.sum())
    said = f"{path.name}: {_rows(n, 'repeats', 'a stamp', 'repeat')}, first {where(at)};"
    return Ordered(order[~is_twice], (*notes, f"{said} the first of each is kept"))


def _rows(n: int, verb: str, rest: str, many: str = "") -> str:
    return f"{n:,} row{'s' if n > 1 else ''} {(many or verb) if n > 1 else verb} {rest}"


def _check_late(
    path: Path, t_s: np.ndarray, xyt: np.ndarray, where: Where, order: np.ndarray,
    *, is_motion: bool,
) -> None:  # fmt: skip
    """Refuse what is no late message: a clock that was set back, or rows in any order."""
    ahead = np.maximum.accumulate(t_s)
    step = np.diff(t_s[order])
    usual = float(np.median(step[step > 0])) if step.any() else 0.0
    is_far = ahead - t_s > max(LATE_S, LATE_ROWS * usual)
    at = int(np.flatnonzero(t_s < ahead)[0])
    longer = driven_m(xyt[order])[-1] > 1.001 * driven_m(xyt)[-1] + SAME_M
    if is_far.any() or (longer and not is_motion):
        what = f"{where(at)}: time runs backwards by {ahead[at] - t_s[at]:.6g} s"
        fix = "cut the file where the clock was set back, or sort the rows by time"
        raise fail(path, what, fix)


def offset_of(
    t_s: Float[np.ndarray, " n"], other_s: Float[np.ndarray, " m"], gate_s: float
) -> float | None:
    """Return what brings one clock onto another, where counts and intervals agree; else None.

    Args:
        t_s: (n,) stamps [s].
        other_s: stamps of as many rows on the other clock.
        gate_s: no stamp may be farther away than this.
    """
    if len(t_s) != len(other_s) or len(t_s) < 3:
        return None
    away = other_s - t_s
    offset = float(np.median(away))
    step = float(np.median(np.diff(other_s)))
    is_near = np.abs(away - offset).max() <= min(gate_s, 0.25 * step)
    return offset if is_near and step > 0 else None
