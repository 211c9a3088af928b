"""Readers of public recordings: NUFR-KRI, ViViD++, Oxford RobotCar, MulRan and KAIST, STheReO."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from taojax.datasets.folder import Session
from taojax.datasets.sessions import (
    Matching,
    agreed_headings,
    check_unit,
    checked_drive,
    matched_session,
    own_session,
    present,
    stamp_of,
    stamped_images,
)
from taojax.datasets.trajectories import row_of
from taojax.datasets.trajectory import Trajectory, headings
from taojax.errors import InputError
from taojax.files.specs import column_names, fail, read_text
from taojax.files.tables import read_table

__all__ = [
    "KRI_CAMERA",
    "KRI_VARIANT",
    "ROBOTCAR_CAMERA",
    "STHEREO_CAMERA",
    "VIVID_IMAGES",
    "check_sensors",
    "read_complex_urban",
    "read_frame_list",
    "read_kri",
    "read_mulran",
    "read_robotcar",
    "read_sthereo",
    "read_vivid",
]

DIGITS = 19
"""Of stamps in nanoseconds, which name frames in several sets."""

KRI_CAMERA, KRI_VARIANT = "cam_3", "matlab_clahe2"

KRI_NOTE = "route progress, no metric poses: frames are spread evenly over"


def read_kri(
    folder: Path,
    *,
    camera: str = KRI_CAMERA,
    variant: str = KRI_VARIANT,
    route_m: float | None = None,
    n_rows: int | None = None,
) -> Session:
    """Read one sequence of NUFR-KRI as progress along its route.

    Args:
        folder: the sequence, with <camera>/<variant>/ below it; or that folder itself.
        camera: its camera.
        variant: how its images were prepared.
        route_m: length of the route [m]; it is the same for every sequence of it.
        n_rows: without a length, the route is so many rows long and the unit is a row; by default
            the frames of this sequence.

    Returns:
        All frames; x is index / (N - 1) times the route, y and theta are zero.

    Raises:
        InputError: there are no such images, or a name is no stamp.

    Source:
        Keil et al., 2024; the paper's route-progress protocol (Table 3).
    """
    if route_m is not None and not route_m > 0:
        raise InputError(f"a route of {route_m:g} m has no places; its length must be positive")
    if not folder.is_dir():
        raise fail(folder, "no such folder", "point at a sequence such as kri_day_2")
    images = folder / camera / variant
    if not images.is_dir() and any(folder.glob("*.png")):
        images = folder
    names, stamps = stamped_images(images, DIGITS)
    length = (n_rows or len(names)) - 1 if route_m is None else route_m
    x = np.linspace(0.0, float(length), len(names))
    flat = np.zeros_like(x)
    unit = "rows" if route_m is None else "m"
    notes = [f"{KRI_NOTE} {length:g} {unit}"]
    unread = sorted(path.name for path in folder.glob("*.csv"))
    if unread:
        notes.append(f"{', '.join(unread)} was not read: what it holds is not confirmed")
    drive = Trajectory(stamps / 1e9, np.stack([x, flat, flat], axis=1))
    return Session(names, drive, False, tuple(notes))


VIVID_IMAGES = "img/thermal_fieldscale_clahe"

VIVID_LEAST_M = 2.0
"""GPS wanders by less, so that a heading over this distance is one."""


def read_vivid(
    folder: Path,
    *,
    images: str = VIVID_IMAGES,
    matching: Matching | None = None,
) -> Session:
    """Read one driving sequence of ViViD++.

    Args:
        folder: holds gpslist.txt or thermal_gps_framelist.txt.
        images: folder whose files `<seconds>.png` are the frames. Where it is not at hand the rows
            of thermal_gps_framelist.txt are, and where that is not either those of gpslist.txt.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a position; headings are derived.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Lee et al., ViViD++, RA-L 2022.
    """
    listed = folder / "thermal_gps_framelist.txt"
    track = folder / "gpslist.txt"
    is_shown = (folder / images).is_dir()
    if not is_shown and images != VIVID_IMAGES:
        raise fail(folder / images, "no such folder of images", "choose another --frames")
    path = track if is_shown or not listed.is_file() else listed
    if path == track and not track.exists() and listed.is_file():
        path = listed
    table = read_table(present(path), "vivid_gpslist")
    check_unit(path, "t_s", table["t_s"], "seconds")
    xy = np.stack([table["x_m"], table["y_m"]], axis=1)
    flat, notes = checked_drive(path, table["t_s"], np.column_stack([xy, np.zeros(len(xy))]), 1.0)
    theta = headings(flat.xyt[:, :2], VIVID_LEAST_M)
    drive = Trajectory(flat.t_s, np.column_stack([flat.xyt[:, :2], theta]))
    notes = (*notes, "the headings are derived from the positions")
    if not is_shown:
        return own_session([f"{t!r}.png" for t in drive.t_s.tolist()], drive, notes)
    frames = _vivid_frames(folder / images)
    return matched_session(folder / images, frames, drive, matching or Matching(), notes)


def _vivid_frames(folder: Path) -> tuple[tuple[str, ...], Float[np.ndarray, " n"]]:
    """Return names `<seconds>.png` and their stamps [s], in time order."""
    found = []
    for path in folder.iterdir():
        if path.suffix != ".png" or path.name.startswith("."):
            continue
        whole, _, part = path.stem.partition(".")
        if not (path.stem.isascii() and whole.isdigit() and (not part or part.isdigit())):
            what = "its name is not a time in seconds"
            raise fail(path, what, "restore the name or remove the file")
        found.append((float(path.stem), path.name))
    if not found:
        raise fail(folder, "holds no frames", "expected names such as 1600000000.123456.png")
    found.sort()
    return tuple(name for _, name in found), np.array([t for t, _ in found])


ROBOTCAR_CAMERA = "stereo/centre"

ROBOTCAR_KEYS = ("timestamp", "northing", "easting", "down", "roll", "pitch", "yaw")
"""Columns that are used or guard those that are; a header must have them where the devkit does."""


def read_robotcar(
    folder: Path,
    *,
    camera: str = ROBOTCAR_CAMERA,
    gps: Literal["ins", "rtk"] = "ins",
    matching: Matching | None = None,
) -> Session:
    """Read one traverse of Oxford RobotCar.

    Args:
        folder: holds gps/.
        camera: folder of the images; where it is not at hand its list `stereo.timestamps` is
            read, and where that is not either the poses are the frames.
        gps: which of gps/ins.csv and gps/rtk.csv.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose: x east, y north, theta counter-clockwise from east.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Maddern et al., 1 Year, 1000 km, IJRR 2017.
    """
    path = folder / "gps" / f"{gps}.csv"
    other = path.with_name("rtk.csv" if gps == "ins" else "ins.csv")
    if not path.exists() and other.exists():
        raise fail(path, f"no such file, but {other.name} is there", f"add --gps {other.stem}")
    table = _read_gps(present(path), f"robotcar_{gps}")
    xyt = np.stack([table["easting"], table["northing"], np.pi / 2.0 - table["yaw"]], axis=1)
    drive, repeats = checked_drive(path, table["timestamp"], xyt, 1e-6)
    theta, turned = agreed_headings(drive.xyt)
    drive = Trajectory(drive.t_s, np.column_stack([drive.xyt[:, :2], theta]))
    notes = (*repeats, *turned)
    found = _robotcar_frames(folder, camera)
    if found is None:
        kept = np.concatenate([[True], np.diff(table["timestamp"]) > 0])
        return own_session([str(stamp) for stamp in table["timestamp"][kept]], drive, notes)
    source, names, stamps = found
    return matched_session(source, (names, stamps / 1e6), drive, matching or Matching(), notes)


def _read_gps(path: Path, spec: str) -> dict[str, np.ndarray]:
    header = [cell.strip() for cell in read_text(path).partition("\n")[0].split(",")]
    columns = column_names(spec)
    if "timestamp" in header:
        for key in ROBOTCAR_KEYS:
            at = columns.index(key)
            if at >= len(header) or header[at] != key:
                what = f"row 1: column {at + 1} is not {key}"
                raise fail(path, what, f"expected {','.join(columns)}")
    table = read_table(path, spec)
    check_unit(path, "timestamp", table["timestamp"], "microseconds")
    zone = table["utm_zone"]
    if (mixed := np.flatnonzero(zone != zone[0])).size:
        row = row_of(path, len(zone), int(mixed[0]))
        what = f"{row}: UTM zone {zone[mixed[0]]}, but {zone[0]} before"
        raise fail(path, what, "project all rows to one zone")
    return table


def _robotcar_frames(
    folder: Path, camera: str
) -> tuple[Path, tuple[str, ...], Int[np.ndarray, " n"]] | None:
    """Return where the frames are listed, their names and stamps [us]."""
    if (folder / camera).is_dir():
        return folder / camera, *stamped_images(folder / camera, 16)
    path = folder / f"{Path(camera).parts[0]}.timestamps"
    if not path.is_file():
        if camera != ROBOTCAR_CAMERA:
            raise fail(folder / camera, "no such folder of images", "choose another --camera")
        return None
    stamps = read_table(path, "robotcar_timestamps")["timestamp"]
    check_unit(path, "timestamp", stamps, "microseconds")
    return path, tuple(f"{stamp}.png" for stamp in stamps), stamps


MULRAN_FRAMES = {
    "mulran": ("sensor_data/Ouster", "sensor_data/radar/polar"),
    "complex_urban": ("image/stereo_left",),
}
"""Where frames usually lie; the first folder that is there counts."""

UNIT_LENGTH = 1e-2
"""Slack of a rotation's first column."""


def read_mulran(
    folder: Path, *, frames: str | None = None, matching: Matching | None = None
) -> Session:
    """Read one sequence of MulRan.

    Args:
        folder: holds global_pose.csv.
        frames: folder below whose files, named by their stamp, are the frames; by default the
            lidar scans, else the radar images, else the poses themselves.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose of the vehicle's base, in UTM zone 52N. The lidar looks
        backwards: poses that are the lidar's are turned round, and a note says so.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Kim et al., MulRan, ICRA 2020; thirteen columns, the 3x4 matrix row by row.
    """
    return _read_mulran(folder, "mulran", frames, matching or Matching())


def read_complex_urban(
    folder: Path, *, frames: str | None = None, matching: Matching | None = None
) -> Session:
    """Read one sequence of KAIST Complex Urban.

    Args:
        folder: holds global_pose.csv.
        frames: as in `read_mulran`; by default the left camera, else the poses themselves.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose, in UTM zone 52N.

    Raises:
        InputError: a file is missing or breaks its spec, or too few frames have a pose.

    Source:
        Jeong et al., Complex Urban Dataset, IJRR 2019; poses as in MulRan.
    """
    return _read_mulran(folder, "complex_urban", frames, matching or Matching())


def _read_mulran(
    folder: Path,
    name: Literal["mulran", "complex_urban"],
    frames: str | None,
    matching: Matching,
) -> Session:
    path = present(folder / "global_pose.csv")
    table = read_table(path, f"{name}_global_pose")
    check_unit(path, "stamp_ns", table["stamp_ns"], "nanoseconds")
    length = np.sqrt(table["r11"] ** 2 + table["r21"] ** 2 + table["r31"] ** 2)
    if (bent := np.flatnonzero(np.abs(length - 1.0) > UNIT_LENGTH)).size:
        row = row_of(path, len(length), int(bent[0]))
        what = f"{row}: column (r11, r21, r31) has length {length[bent[0]]:.3f}"
        raise fail(path, what, "expected a rotation; store the 3x4 matrix row by row")
    theta = np.arctan2(table["r21"], table["r11"])
    xyt = np.stack([table["x_m"], table["y_m"], theta], axis=1)
    drive, repeats = checked_drive(path, table["stamp_ns"], xyt, 1e-9)
    theta, turned = agreed_headings(drive.xyt, may_turn=True)
    drive = Trajectory(drive.t_s, np.column_stack([drive.xyt[:, :2], theta]))
    notes = (*repeats, *turned)
    images = _mulran_frames(
        folder, MULRAN_FRAMES[name] if frames is None else (frames,), frames is not None
    )
    if images is None:
        kept = np.concatenate([[True], np.diff(table["stamp_ns"]) > 0])
        return own_session([str(stamp) for stamp in table["stamp_ns"][kept]], drive, notes)
    names, stamps = stamped_images(images, DIGITS, (".bin", ".png"))
    return matched_session(images, (names, stamps / 1e9), drive, matching, notes)


def _mulran_frames(folder: Path, usual: Sequence[str], is_wanted: bool) -> Path | None:
    """Return the folder of the frames; None where there is none and none was asked for."""
    for name in usual:
        if is_wanted or (folder / name).is_dir():
            return folder / name
    return None


STHEREO_CAMERA = "stereo_thermal_14_left"
"""The camera of the paper; thermal images of the right one have stamps of their own."""

"""Of UNIX time in nanoseconds."""

SENSORS = ("data_stamp", "gps", "inspva", "xsens_imu")

LOCAL_NOTE = (
    "local poses: that the sequences share a frame is not known; the odd first and last row are"
    " left out"
)


def read_sthereo(
    source: Path,
    *,
    camera: str = STHEREO_CAMERA,
    is_local: bool = False,
    matching: Matching | None = None,
) -> Session:
    """Read one sequence of STheReO.

    Args:
        source: a folder that holds image/ and pose/, or a frame list.
        camera: folder below image/ whose files are the frames.
        is_local: take pose/local_pose.csv instead of pose/global_pose.csv.
        matching: how a frame comes to its pose.

    Returns:
        The frames that have a pose, in UTM zone 52N.

    Raises:
        InputError: a file is missing or breaks its spec, a name is no stamp, or too few frames
            have a pose.

    Source:
        Yun et al., STheReO, IROS 2022; poses have seven columns with time in seconds.
    """
    if source.is_file():
        return read_frame_list(source)
    if not any((source / part).exists() for part in ("image", "image.tar", "pose", "pose.tar")):
        wanted = "expected a sequence with image/ and pose/, or a frame list"
        raise fail(source, "is no STheReO sequence", wanted)
    name = "local_pose" if is_local else "global_pose"
    path = present(source / "pose" / f"{name}.csv")
    table = read_table(path, f"sthereo_{name}")
    check_unit(path, "t_s", table["t_s"], "seconds")
    xyt = np.stack([table["x_m"], table["y_m"], np.deg2rad(table["yaw_deg"])], axis=1)
    t_s, notes = table["t_s"], ()
    if is_local:
        t_s, xyt, notes = t_s[1:-1], xyt[1:-1], (LOCAL_NOTE,)
    drive, repeats = checked_drive(path, t_s, xyt, 1.0, n_odd=int(is_local))
    theta, turned = agreed_headings(drive.xyt)
    drive = Trajectory(drive.t_s, np.column_stack([drive.xyt[:, :2], theta]))
    names, stamps = stamped_images(source / "image" / camera, DIGITS)
    frames = names, stamps / 1e9
    said = (*notes, *repeats, *turned)
    return matched_session(source / "image" / camera, frames, drive, matching or Matching(), said)


def read_frame_list(path: Path) -> Session:
    """Read a list of frames with the positions that its maker gave them.

    Args:
        path: lines `rgb.png thermal.png easting northing altitude`.

    Returns:
        The thermal images, stamped by their names; headings follow the positions.

    Raises:
        InputError: the list breaks its spec, or a name is no stamp.
    """
    table = read_table(path, "sthereo_frame_list")
    names = [str(name) for name in table["thermal"]]
    stamps = np.array([_sthereo_stamp(path, at, names) for at in range(len(names))], np.int64)
    xy = np.stack([table["x_m"], table["y_m"]], axis=1)
    flat, repeats = checked_drive(path, stamps, np.column_stack([xy, np.zeros(len(xy))]), 1e-9)
    xy = flat.xyt[:, :2]
    stays = np.concatenate([[True], np.diff(stamps) > 0])
    kept = tuple(name for name, is_first in zip(names, stays, strict=True) if is_first)
    said = "a frame list: every frame has the position of the pose nearest in time, and the"
    return Session(
        kept,
        Trajectory(flat.t_s, np.column_stack([xy, headings(xy)])),
        True,
        (*repeats, f"{said} headings are derived from the positions"),
        listed=tuple(names),
    )


def _sthereo_stamp(path: Path, at: int, names: list[str]) -> int:
    stamp = stamp_of(names[at], DIGITS)
    if stamp is None:
        row = row_of(path, len(names), at)
        what = f"{row}, column thermal: {names[at][:40]!r} is not a stamp of {DIGITS} digits"
        raise fail(path, what, "restore the name or remove the row")
    return stamp


def check_sensors(source: Path) -> tuple[str, ...]:
    """Hold the other sensors of a sequence against their specs, where they are there.

    Args:
        source: a sequence; a frame list has no sensors.

    Returns:
        Names of the files that were read and are sound; nothing else is taken from them.

    Raises:
        InputError: a file breaks its spec.
    """
    sound = []
    for name in SENSORS:
        path = source / "sensor_data" / f"{name}.csv"
        if path.is_file():
            check_unit(
                path, "stamp_ns", read_table(path, f"sthereo_{name}")["stamp_ns"], "nanoseconds"
            )
            sound.append(path.name)
    return tuple(sound)
