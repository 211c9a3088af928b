"""`taojax convert` of the other public sets: round trips, conventions, and ways to be broken."""

import gzip

import foreign
import numpy as np
import pytest

from taojax.cli import main
from taojax.datasets.public_sets import (
    read_complex_urban,
    read_kri,
    read_mulran,
    read_robotcar,
    read_vivid,
)
from taojax.errors import InputError
from taojax.files.tables import read_table
from taojax.runtime.observations import load_observations

FRAMES_S = foreign.stamps(58, 1.0, 0.13)
TRUE = foreign.pose_at(FRAMES_S)


def off(poses, true=TRUE):
    """Largest error of poses: metres or radians."""
    away = poses - true
    away[:, 2] = np.angle(np.exp(1j * away[:, 2]))
    return np.abs(away).max()


def converted(tmp_path, capsys, kind, *words):
    """Convert a pair with simulated views; return the data folder and what was said."""
    out = tmp_path / "out"
    pair = str(tmp_path / "map"), str(tmp_path / "query")
    assert main(["convert", kind, *pair, str(out), "--simulate-descriptors", *words]) == 0
    return load_observations(out), capsys.readouterr().err


def motion_error(seen):
    """Largest error of the converted odometry against the true drive."""
    c, s = np.cos(TRUE[:-1, 2]), np.sin(TRUE[:-1, 2])
    dx, dy = np.diff(TRUE[:, :2], axis=0).T
    turn = np.angle(np.exp(1j * np.diff(TRUE[:, 2])))
    true = np.stack([c * dx + s * dy, c * dy - s * dx, turn], axis=1)
    return np.abs(seen.odometry[1:] - true).max()


# MulRan and Complex Urban


def test_mulran_scans_get_the_poses_of_the_base(tmp_path, capsys):
    foreign.mulran(tmp_path / "map")
    foreign.mulran(tmp_path / "query", left_m=1.0)
    session = read_mulran(tmp_path / "map")
    assert session.frames[0] == f"{foreign.ns(0.13)}.bin"
    assert off(session.poses.xyt) < 0.01
    seen, said = converted(tmp_path, capsys, "mulran")
    assert len(seen.t_s) == 58
    assert "simulated odometry" in said


def test_lidar_poses_that_look_backwards_are_turned_round_and_said(tmp_path):
    foreign.mulran(tmp_path / "map", turned=np.pi)
    session = read_mulran(tmp_path / "map")
    assert off(session.poses.xyt) < 0.01
    assert any("180 degrees off" in note and "turned round" in note for note in session.notes)


@pytest.mark.parametrize(
    ("frames", "suffix"), [("sensor_data/radar/polar", ".png"), ("sensor_data/other", ".bin")]
)
def test_frames_lie_where_they_are_told_to_lie(tmp_path, frames, suffix):
    foreign.mulran(tmp_path / "map", frames=frames, suffix=suffix)
    assert len(read_mulran(tmp_path / "map", frames=frames).frames) == 58
    with pytest.raises(InputError, match="no such folder"):
        read_mulran(tmp_path / "map", frames="sensor_data/none")


def test_without_scans_the_poses_are_the_frames(tmp_path):
    foreign.mulran(tmp_path / "map", frames=None)
    session = read_mulran(tmp_path / "map")
    assert session.frames[:2] == (foreign.ns(0.0), foreign.ns(0.1))
    assert off(session.poses.xyt, foreign.pose_at(foreign.stamps(600, 0.1))) < 1e-6
    assert any("the poses themselves are the frames" in note for note in session.notes)


def test_complex_urban_drives_on_wheels_and_gyro_where_they_are_there(tmp_path, capsys):
    for side in ("map", "query"):
        folder = tmp_path / side
        foreign.mulran(folder, frames="image/stereo_left", suffix=".png")
        foreign.wheels(folder)
    assert off(read_complex_urban(tmp_path / "map").poses.xyt) < 0.01
    seen, said = converted(tmp_path, capsys, "complex-urban")
    assert motion_error(seen) < 0.05
    assert "odometry from query (wheels)" in said
    (tmp_path / "query/calibration/EncoderParameter.txt").unlink()
    words = [str(tmp_path / name) for name in ("map", "query", "again")]
    assert main(["convert", "complex-urban", *words, "--simulate-descriptors"]) == 0
    assert "simulated odometry" in capsys.readouterr().err


# Oxford RobotCar


def test_robotcar_reads_north_east_down_and_its_own_visual_odometry(tmp_path, capsys):
    for side in ("map", "query"):
        foreign.robotcar(tmp_path / side)
    session = read_robotcar(tmp_path / "map")
    assert session.frames[0] == f"{foreign.us(0.13)}.png"
    assert off(session.poses.xyt) < 0.01
    assert not any("direction of travel" in note for note in session.notes)
    seen, said = converted(tmp_path, capsys, "robotcar")
    # The drive goes straight between poses a quarter of a second apart.
    assert motion_error(seen) < 0.02
    assert "odometry from vo.csv (robotcar-vo)" in said
    assert not any("simulated odometry" in note for note in seen.notes)


def test_robotcar_frames_are_images_their_list_or_the_poses(tmp_path):
    images = foreign.robotcar(tmp_path / "a", listed=False)
    foreign.touch(images / "stereo/centre", [f"{foreign.us(t)}.png" for t in FRAMES_S[:9]])
    assert len(read_robotcar(images).frames) == 9
    bare = foreign.robotcar(tmp_path / "b", listed=False)
    assert len(read_robotcar(bare).frames) == 600
    with pytest.raises(InputError, match="mono_left"):
        read_robotcar(bare, camera="mono_left")


def test_robotcar_rtk_has_one_column_less(tmp_path):
    folder = foreign.robotcar(tmp_path / "a")
    rows = [[row[0], *row[2:]] for row in foreign.ins_rows()]
    foreign.write(folder / "gps/rtk.csv", rows, header=foreign.RTK)
    assert off(read_robotcar(folder, gps="rtk").poses.xyt) < 0.01
    (folder / "gps/ins.csv").unlink()
    with pytest.raises(InputError, match=r"rtk.csv is there; add --gps rtk"):
        read_robotcar(folder)


def test_robotcar_yaw_in_another_sense_is_replaced_and_said(tmp_path):
    folder = foreign.robotcar(tmp_path / "a")
    rows = [[*row[:-1], f"{-float(row[-1]):.9f}"] for row in foreign.ins_rows()]
    foreign.write(folder / "gps/ins.csv", rows, header=foreign.INS)
    session = read_robotcar(folder)
    assert off(session.poses.xyt) < 0.15
    assert any("derived from positions" in note for note in session.notes)


# ViViD++


@pytest.mark.parametrize("shown", [True, False])
def test_vivid_frames_are_images_or_the_list_of_them(tmp_path, capsys, shown):
    for side in ("map", "query"):
        foreign.vivid(tmp_path / side, shown=shown, listed=not shown)
    session = read_vivid(tmp_path / "map")
    assert len(session.frames) == 58
    assert session.frames[0] == "1630106835.130000.png"[: None if shown else -8] + (
        "" if shown else ".png"
    )
    assert off(session.poses.xyt) < 0.2
    seen, said = converted(tmp_path, capsys, "vivid")
    assert len(seen.t_s) == 58
    assert "derived from the positions" in said


def test_vivid_without_images_and_lists_takes_the_positions(tmp_path):
    foreign.vivid(tmp_path / "map", shown=False)
    assert len(read_vivid(tmp_path / "map").frames) == 300
    with pytest.raises(InputError, match="--frames"):
        read_vivid(tmp_path / "map", images="img/color")


# NUFR-KRI


def test_kri_is_progress_in_rows_of_the_map_or_in_metres(tmp_path, capsys):
    foreign.kri(tmp_path / "map", 120)
    foreign.kri(tmp_path / "query", 90)
    foreign.write(tmp_path / "map/gps.csv", [["1", "2"]])
    words = "--map-frames", "41", "--query-frames", "30"
    seen, said = converted(tmp_path, capsys, "kri", *words)
    assert seen.map_poses["x_m"] == pytest.approx(np.arange(41), abs=0.3)
    assert not seen.map_poses["y_m"].any()
    truth = read_table(tmp_path / "out/truth/query_poses.csv", "query_poses")
    assert truth["x_m"][[0, -1]] == pytest.approx([0.0, 40.0])
    notes = " ".join(seen.notes)
    assert "route progress, no metric poses" in notes
    assert "along the route progress" in notes
    assert "gps.csv was not read" in said
    by_metre = read_kri(tmp_path / "map", route_m=340.0)
    assert not by_metre.has_pose
    assert by_metre.poses.xyt[-1].tolist() == [340.0, 0.0, 0.0]


def test_kri_takes_the_folder_of_the_images_too_and_names_what_is_missing(tmp_path):
    folder = foreign.kri(tmp_path / "map", 12)
    assert len(read_kri(folder / "cam_3/matlab_clahe2").frames) == 12
    with pytest.raises(InputError, match="there are matlab_clahe2"):
        read_kri(folder, variant="raw")
    with pytest.raises(InputError, match="must be positive"):
        read_kri(folder, route_m=0.0)


# Ways to be broken


def matrix(edit):
    def broken(folder):
        rows = foreign.matrix_rows()
        edit(rows)
        foreign.write(folder / "global_pose.csv", rows)

    return broken


def ins(edit, header=foreign.INS):
    def broken(folder):
        rows = foreign.ins_rows()
        edit(rows)
        foreign.write(folder / "gps/ins.csv", rows, header=header)

    return broken


def change(row, column, text):
    def edit(rows):
        rows[row][column] = text

    return edit


def each(column, change):
    def edit(rows):
        for row in rows:
            row[column] = change(row[column])

    return edit


def swap(a, b):
    def edit(rows):
        for row in rows:
            row[a], row[b] = row[b], row[a]

    return edit


def as_bytes(name, change):
    def broken(folder):
        (folder / name).write_bytes(change((folder / name).read_bytes()))

    return broken


MULRAN = {
    "missing column": (matrix(lambda rows: rows[3].pop()), "row 4: 12 cells", "columns are"),
    "seconds": (matrix(each(0, lambda t: t[:10])), "column stamp_ns: 1630106835", "nanoseconds"),
    "fractions": (matrix(each(0, lambda t: t + ".0")), "row 1, column stamp_ns", "fix the cell"),
    "too many digits": (matrix(each(0, lambda t: t + "000")), "row 1", "whole nanoseconds"),
    "reversed time": (matrix(lambda rows: rows.reverse()), "row 2: stamp_ns", "sort the rows"),
    "not a number": (matrix(change(8, 4, "nan")), "row 9, column x_m", "remove the row"),
    "mixed zones": (matrix(lambda rows: rows.append(
        [foreign.ns(99), *rows[9][1:4], "802821.1", *rows[9][5:]])),
        "row 601: jumps 450 km", "one zone"),
    "swapped easting": (matrix(swap(4, 8)), "row 1, column x_m", "swap x and y"),
    "no rotation": (matrix(each(5, lambda r: "0.0")), "has length", "row by row"),
    "duplicate stamps": (matrix(change(5, 0, foreign.ns(0.4))), "row 6: the stamp", "one row per"),
    "empty file": (as_bytes("global_pose.csv", lambda _: b""), "is empty", "expected the columns"),
    "gzip": (as_bytes("global_pose.csv", gzip.compress), "gzip", "unpack it first"),
    "not UTF-8": (as_bytes("global_pose.csv", lambda b: b"\xff" + b), "line 1 is", "plain CSV"),
    "truncated name": (
        lambda folder: foreign.touch(folder / "sensor_data/Ouster", ["16301068.bin"]),
        "16301068.bin: its name", "restore the name"),
}  # fmt: skip
ROBOTCAR = {
    "missing column": (ins(lambda rows: rows[3].pop()), "row 5: 14 cells", "columns are"),
    "nanoseconds": (ins(each(0, lambda t: t + "000")), "row 2, column timestamp", "microseconds"),
    "reversed time": (ins(lambda rows: rows.reverse()), "row 3: timestamp", "sort the rows"),
    "not a number": (ins(change(8, 5, "nan")), "row 10, column northing", "remove the row"),
    "mixed zones": (ins(change(9, 8, "31U")), "row 11: UTM zone 31U, but 30U", "one zone"),
    "swapped lat/lon": (ins(each(2, lambda _: "127.4")), "column latitude", "swap the columns"),
    "degrees": (ins(each(-1, lambda _: "93.5")), "column yaw", "store radians"),
    "other header": (
        ins(swap(5, 6), foreign.INS.replace("northing,easting", "easting,northing")),
        "row 1: column 6 is not northing", "expected timestamp,ins_status"),
    "swapped easting": (ins(swap(5, 6)), "row 2, column easting", "swap the columns"),
    "empty file": (as_bytes("gps/ins.csv", lambda _: b""), "is empty", "expected the columns"),
    "gzip": (as_bytes("gps/ins.csv", gzip.compress), "gzip", "unpack it first"),
    "not UTF-8": (as_bytes("gps/ins.csv", lambda b: b + b"\xb0"), "is not UTF-8", "plain CSV"),
    "no times": (as_bytes("stereo.timestamps", lambda _: b""), "is empty", "timestamp"),
}  # fmt: skip
VIVID = {
    "missing column": (
        as_bytes("gpslist.txt", lambda b: b.replace(b" 16301068", b"16301068", 1)),
        "gpslist.txt: row", "columns are x_m,y_m,t_s"),
    "milliseconds": (
        as_bytes("gpslist.txt", lambda b: b.replace(b".", b"")), "column t_s", "convert"),
    "jump": (
        as_bytes("gpslist.txt", lambda b: b.replace(b"4025", b"4925", 1)), "jumps", "one zone"),
    "no time in a name": (
        lambda folder: foreign.touch(folder / "img/thermal_fieldscale_clahe", ["a.png"]),
        "a.png: its name", "restore the name"),
}  # fmt: skip
BROKEN = {"mulran": MULRAN, "robotcar": ROBOTCAR, "vivid": VIVID}


@pytest.mark.parametrize(
    ("kind", "how"), [(kind, how) for kind, cases in BROKEN.items() for how in cases]
)
def test_a_broken_sequence_is_exit_3_with_file_row_and_fix(kind, how, tmp_path, capsys):
    breaks, where, fix = BROKEN[kind][how]
    write = getattr(foreign, kind)
    write(tmp_path / "map")
    breaks(write(tmp_path / "query"))
    words = [str(tmp_path / name) for name in ("map", "query", "out")]
    assert main(["convert", kind, *words, "--simulate-descriptors"]) == 3
    line = capsys.readouterr().err.strip()
    assert line.startswith(f"taojax: {tmp_path / 'query'}"), line
    assert "\n" not in line
    assert where in line
    assert fix in line
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))
