"""Files as people have them: what can be read in one way is read and said, the rest is refused
with the flag that decides, and nothing is half-written."""

import datetime
from pathlib import Path

import numpy as np
import pytest

from taojax.cli import main

CASES = Path(__file__).parents[2] / "shared/cases"
N = 60
START_S = 1_700_005_000.0
FLAGS = {
    "08-wxyz-tum": ["--quaternion", "wxyz"],
    "19-g2o-se3": ["--odometry-kind", "g2o"],
    "23-kitti-12": ["--odometry-kind", "kitti", "--times", "t.txt"],
}
SAID = {
    "02-ns-one-side": "o.txt: stamps are recognised as nanoseconds",
    "06-num-header-csv": "not used: num",
    "08-wxyz-tum": "o.txt: quaternions are read as wxyz",
    "09-duplicate-stamps": "o.txt: 1 row repeats a stamp, first row 21; the first of each is kept",
    "10-out-of-order": "o.txt: 1 row came late, first row 22; sorted by time",
    "17-tum-csv-commas": "o.txt: read as tum with commas between the cells",
    "19-g2o-se3": "o.txt: paired with the query frames row by row",
    "20-descriptor-singleton": "mv.npy: shape (80, 1, 32) is read as (80, 32)",
    "22-int8": "mv.npy: int8 numbers are read as float32",
    "23-kitti-12": "o.txt: its clock is 1700005000.000000 s behind that of the frames",
}


def convert(folder, out, *more):
    """Run the command on the five files of a folder, or on what replaces them."""
    named = {"--map-poses": "m.txt", "--odometry": "o.txt", "--query-poses": "q.txt",
             "--map-descriptors": "mv.npy", "--query-descriptors": "qv.npy"}  # fmt: skip
    words = [str(folder / word) if (folder / word).is_file() else word for word in more]
    for flag, name in named.items():
        if flag not in words:
            words += [flag, str(folder / name)]
    return main(["convert", "files", str(out), *words])


def moved(out):
    """Return (T, 4) query/odometry.csv."""
    return np.loadtxt(out / "query/odometry.csv", delimiter=",", skiprows=1)


@pytest.mark.parametrize("name", sorted(SAID))
def test_every_shared_case_is_read_and_said(name, tmp_path, capsys):
    if not (CASES / name).is_dir():
        pytest.skip("the shared cases are not here")
    assert convert(CASES / name, tmp_path / "out", *FLAGS.get(name, [])) == 0
    assert SAID[name] in capsys.readouterr().err
    want = np.loadtxt(CASES / "expected_odometry.csv", delimiter=",", skiprows=1)
    assert moved(tmp_path / "out")[:, 1:] == pytest.approx(want[:, 1:], abs=1e-4)


def test_a_quaternion_with_w_first_is_never_read_without_a_word(tmp_path, capsys):
    if not CASES.is_dir():
        pytest.skip("the shared cases are not here")
    assert convert(CASES / "08-wxyz-tum", tmp_path / "out") == 3
    line = capsys.readouterr().err.strip()
    assert "o.txt: row 1: " in line
    assert "add --quaternion wxyz" in line
    assert not (tmp_path / "out").exists()


# Variants: one drive, written as many people write it.


def drive():
    """(N, 3) of a robot that winds to and fro at two metres a second."""
    theta = 0.5 * np.sin(np.arange(N) / 7.0)
    xyt = np.zeros((N, 3))
    for row in range(1, N):
        ahead = theta[row - 1] + 0.5 * (theta[row] - theta[row - 1])
        xyt[row] = xyt[row - 1] + [np.cos(ahead), np.sin(ahead), 0.0]
    xyt[:, 2] = theta
    return xyt


XYT = drive()
T_S = START_S + 0.5 * np.arange(N)
X, Y, THETA = XYT.T
ZERO = np.zeros(N)
QZ, QW = np.sin(THETA / 2), np.cos(THETA / 2)


def steps():
    d = np.diff(XYT, axis=0)
    c, s = np.cos(THETA[:-1]), np.sin(THETA[:-1])
    out = np.zeros((N, 3))
    out[1:] = np.c_[c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]]
    return out


STEPS = steps()
TUM = [T_S, X, Y, ZERO, ZERO, ZERO, QZ, QW]


def text(columns, separator=" ", header=None, form="{:.6f}", end="\n"):
    """Write columns of numbers, or of ready words, as a table."""
    cells = [[v if isinstance(v, str) else form.format(v) for v in column] for column in columns]
    lines = [separator.join(row) for row in zip(*cells, strict=True)]
    return end.join([*([header] if header else []), *lines]) + end


def whole(scale, start=START_S):
    return [str(round(start) * scale + row * scale // 2) for row in range(N)]


def matrices(up=False):
    """Twelve columns of a camera with y down, or up."""
    c, s = np.cos(THETA), (np.sin(THETA) if up else -np.sin(THETA))
    x = Y if up else -Y
    return [c, ZERO, s, x, ZERO, ZERO + 1, ZERO, ZERO, -s, ZERO, c, X]


@pytest.fixture
def plain(tmp_path):
    """The plain case: everything TUM, in seconds, one row per image."""
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "m.txt").write_text(text([T_S - 5000, *TUM[1:]]))
    (folder / "q.txt").write_text(text(TUM))
    (folder / "o.txt").write_text(text(TUM))
    rng = np.random.default_rng(5)
    for name in ("mv.npy", "qv.npy"):
        np.save(folder / name, rng.normal(size=(N, 8)).astype(np.float32))
    return folder


def swapped(lines, at=20):
    lines = lines.splitlines()
    lines[at], lines[at + 1] = lines[at + 1], lines[at]
    return "\n".join(lines) + "\n"


def twice(lines, at=20, n=1):
    lines = lines.splitlines()
    lines[at:at] = [lines[at]] * n
    return "\n".join(lines) + "\n"


def dates(zone="Z"):
    at = [datetime.datetime.fromtimestamp(t, datetime.UTC) for t in T_S]
    return [t.strftime("%Y-%m-%dT%H:%M:%S.%f") + zone for t in at]


def comma(columns, separator, form="{:.6f}"):
    return text(columns, separator, form=form).replace(".", ",")


ROS = ("%time,field.header.seq,field.header.stamp,field.header.frame_id,"
       "field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,"
       "field.pose.pose.orientation.x,field.pose.pose.orientation.y,field.pose.pose.orientation.z,"
       "field.pose.pose.orientation.w,field.pose.covariance0,field.twist.twist.linear.x,"
       "field.twist.twist.angular.z")  # fmt: skip
COUNT = [str(row) for row in range(N)]
DEG = np.degrees(THETA)

READ = {
    "milliseconds": (text([whole(10**3), *TUM[1:]]), [], "recognised as milliseconds"),
    "microseconds": (text([whole(10**6), *TUM[1:]]), [], "recognised as microseconds"),
    "nanoseconds in floats": (
        text([T_S * 1e9, *TUM[1:]], form="{:.18e}"), [], "recognised as nanoseconds"),
    "milliseconds from zero": (
        text([whole(10**3, 0), *TUM[1:]]), [], "recognised as milliseconds, by steps of 500"),
    "nanoseconds from zero": (
        text([whole(10**9, 0), *TUM[1:]]), [], "o.txt: its clock is 1700005000.000000 s behind"),
    "seconds from zero": (
        text([T_S - START_S, *TUM[1:]]), [], "found by equal counts and intervals"),
    "an offset that is told": (
        text([T_S - START_S, *TUM[1:]]), ["--clock-offset", "1700005000"], "as you say"),
    "an offset the other way": (
        text([T_S + 3600, *TUM[1:]]), [], "o.txt: its clock is 3600.000000 s ahead of"),
    "commas": (text(TUM, ","), [], "read as tum with commas"),
    "commas and blanks": (text(TUM, ", "), [], "read as tum with commas"),
    "semicolons": (text(TUM, ";"), [], "read as tum with semicolons"),
    "tabs": (text(TUM, "\t"), [], "read as tum with tabs"),
    "many blanks": (text(TUM, "   "), [], "read as tum"),
    "windows": (
        "\ufeff" + text(TUM, ",", "timestamp,tx,ty,tz,qx,qy,qz,qw", end="\r\n"), [],
        "timestamp = t_s, tx = x_m"),
    "decimal commas": (comma(TUM, ";"), [], "commas are read as decimal signs"),
    "decimal commas between blanks": (comma(TUM, " "), [], "commas are read as decimal signs"),
    "decimal commas that are told": (
        comma([T_S, X, Y, THETA], ";", "{:.6f}"), ["--decimal", "comma", "--columns", "t,x,y,yaw"],
        "columns as you say"),
    "x,y,theta": (text([X, Y, THETA], ",", "x,y,theta"), [], "row by row, as o.txt has no time"),
    "px;py;yaw": (text([T_S, X, Y, THETA], ";", "t;px;py;yaw"), [], "px = x_m, py = y_m"),
    "capitals and units": (
        text([T_S, X, Y, THETA], ",", "Time [s],X [m],Y [m],Yaw [rad]"), [], "Yaw [rad] = theta"),
    "millimetres": (
        text([T_S, X * 1e3, Y * 1e3, THETA], ",", "t,x_mm,y_mm,yaw"), [], "x_mm = x_m"),
    "degrees by name": (
        text([T_S, X, Y, DEG], ",", "t,x,y,yaw_deg"), [], "yaw_deg is read as degrees"),
    "degrees by motion": (text([T_S, X, Y, DEG], ",", "t,x,y,yaw"), [], "yaw is read as degrees"),
    "compass": (
        text([T_S, X, Y, 90 - DEG], ",", "t,easting,northing,heading"), [],
        "heading is read as degrees clockwise from north"),
    "columns in another order": (
        text([QW, ZERO, ZERO, QZ, Y, X, T_S], ",", "qw,qx,qy,qz,y,x,t"), [], "y = y_m, x = x_m"),
    "a row number without a name": (text([COUNT, *TUM], ",", ",t,x,y,z,qx,qy,qz,qw"), [],
                                    "an unnamed column"),
    "a row number without a header": (text([COUNT, *TUM]), [], "behind a row number"),
    "names in a comment": (
        "# made by slam\n" + text([T_S, X, Y, THETA], " ", "# t x y theta"), [], "theta = theta"),
    "a line of units": (
        text([T_S, X, Y, THETA], ",", "t,x,y,yaw\ns,m,m,rad"), [], "yaw [rad] = theta_rad"),
    "rostopic echo": (
        text([whole(10**9), COUNT, whole(10**9), ["odom"] * N, X, Y, ZERO, ZERO, ZERO, QZ, QW, ZERO,
              ZERO + 2, ZERO], ",", ROS), [], "field.header.stamp = t_s"),
    "seconds and nanoseconds": (
        text([[str(int(t)) for t in T_S], [str(round(t % 1 * 1e9)) for t in T_S], X, Y, THETA], ",",
             "secs,nsecs,x,y,yaw"), [], "secs = t_s, nsecs = t_s"),
    "dates": (text([dates(), X, Y, THETA], ",", "datetime,x,y,yaw"), [], "datetime = t_s"),
    "steps by names": (
        text([T_S, *STEPS.T], ",", "stamp,dx,dy,dyaw"), [], "dx = dx_m, dy = dy_m"),
    "steps without stamps": (text(STEPS.T, ",", "dx,dy,dtheta"), [], "row by row"),
    "no header, x y theta": (
        text([X, Y, THETA]), ["--odometry-kind", "poses"], "no header: read as x_m,y_m,theta_rad"),
    "no header, t x y theta": (
        text([T_S, X, Y, THETA]), ["--odometry-kind", "poses"], "no header: read as t_s,x_m,y_m"),
    "one row three times": (twice(text(TUM), n=2), [], "2 rows repeat a stamp, first row 22"),
    "three rows late": (
        swapped(swapped(swapped(text(TUM)), 40), 50), [], "3 rows came late, first row 22"),
    "late and repeated": (twice(swapped(text(TUM)), 40), [], "1 row came late"),
    "g2o in the plane": (
        text([["VERTEX_SE2"] * N, COUNT, X, Y, THETA]), [], "o.txt: read as g2o"),
    "g2o in any order": (
        "\n".join(text([["VERTEX_SE2"] * N, COUNT, X, Y, THETA]).splitlines()[::-1]), [],
        "vertices are put in the order of their ids"),
    "kitti": (text(matrices()), ["--odometry-kind", "kitti"], "row by row"),
    "kitti with y up": (text(matrices(up=True)), [], "laid flat as xz-up"),
    "kitti with y up, told": (text(matrices(up=True)), ["--plane", "xz-up"], "read as kitti"),
    "kitti with commas": (text(matrices(), ","), [], "read as kitti with commas"),
    "wxyz, told": (
        text([T_S, X, Y, ZERO, QW, ZERO, ZERO, QZ]), ["--quaternion", "wxyz"],
        "m.txt: quaternions stay xyzw"),
    "whole stamps with commas, w last": (
        text([whole(10**9), *TUM[1:]], ","), [], "quaternions are read as xyzw, by the direction"),
    "whole stamps with commas, w first": (
        text([whole(10**9), X, Y, ZERO, QW, ZERO, ZERO, QZ], ","), [], "read as euroc"),
    "a last line cut off": (
        text([np.r_[T_S, T_S[-1] + 0.5], *(np.r_[c, c[-1]] for c in TUM[1:])])[:-30], [],
        "is cut off in the middle"),
    "no stamps, a quaternion": (text(TUM[1:]), [], "no header: read as x,y,z,qx,qy,qz,qw"),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_odometry_that_can_be_read_in_one_way_is_read_and_said(name, plain, tmp_path, capsys):
    body, flags, said = READ[name]
    (plain / "o.txt").write_bytes(body.encode())
    assert convert(plain, tmp_path / "out", *flags) == 0
    assert said in capsys.readouterr().err
    got = moved(tmp_path / "out")
    assert got[:, 0] == pytest.approx(T_S, abs=1e-6)
    assert got[:, 1:] == pytest.approx(STEPS, abs=2e-4)
    assert said in (tmp_path / "out/about.toml").read_text().replace('\\"', '"')


def test_fast_stamps_are_told_by_the_speed_of_many_rows(plain, tmp_path, capsys):
    fine = np.arange(50 * N - 49) / 50
    rows = [np.interp(fine, np.arange(N), column) for column in (X, Y, THETA)]
    stamps = [str(10 * row) for row in range(len(fine))]
    (plain / "o.txt").write_text(text([stamps, *rows], ",", "stamp,x,y,yaw", form="{:.9f}"))
    assert convert(plain, tmp_path / "out", "--clock-offset", str(START_S)) == 0
    assert "o.txt: stamps are recognised as milliseconds, by steps of 10" in capsys.readouterr().err
    assert moved(tmp_path / "out")[:, 1:] == pytest.approx(STEPS, abs=2e-4)


def test_a_unit_that_cannot_be_is_said_to_be_none(plain, tmp_path, capsys):
    assert convert(plain, tmp_path / "out", "--time-unit", "ns") == 0
    said = capsys.readouterr().err
    for name in "moq":
        assert f"{name}.txt: stamps are seconds, they cannot be nanoseconds" in said


REFUSED = {
    "w first": (text([T_S, X, Y, ZERO, QW, ZERO, ZERO, QZ]), ["row 1", "--quaternion wxyz"]),
    "two clocks and two counts": (
        text([T_S[:50] - START_S, *(c[:50] for c in TUM[1:])]), ["--clock-offset 1700005000"]),
    "one stamp, two poses": (
        text([np.r_[T_S[:20], T_S[19:]], *(np.r_[c[:20], c[30], c[20:]] for c in TUM[1:])]),
        ["row 21", "the stamp of row 20"]),
    "a clock set back": (
        text([np.r_[T_S[:30], T_S[:30]], *TUM[1:]]), ["row 31", "runs backwards"]),
    "rows in no order": (
        text([c[np.random.default_rng(1).permutation(N)] for c in TUM]), ["runs backwards"]),
    "latitude": (text([T_S, X, Y], ",", "t,lat,lon"), ["lat", "project", "metres"]),
    "three numbers": (
        text([T_S, X, Y + 2 * X]), ["o.txt does not say what it holds", "--odometry-kind"]),
    "five numbers": (text([T_S, X, Y, ZERO, ZERO]), ["does not say", "--columns"]),
    "two positions": (text([X, Y, X, Y], ",", "gt_x,gt_y,est_x,est_y"), ["'gt_x' and 'est_x'"]),
    "no known name": (text([X, Y], ",", "foo,bar"), ["header is 'foo,bar'", "t_s,x_m,y_m"]),
    "half a quaternion": (text([T_S, X, Y, QZ], ",", "t,x,y,qz"), ["only qz", "qx,qy,qz,qw"]),
    "thousands or decimals": (
        comma([[f"{v:.3f}" for v in 1 + np.arange(N) / 7]] * 3, ";"), ["--decimal comma"]),
    "cells of two widths": ("1 2 3 4\n1 2 3\n" + text(TUM), ["row 2", "3 cells where 4"]),
    "a word in a cell": (text(TUM).replace(" 1.000000\n", " one\n", 1), ["row 1", "'one'"]),
    "fewer vertices than images": (
        text([["VERTEX_SE2"] * 50, COUNT[:50], X[:50], Y[:50], THETA[:50]]),
        ["50 rows without stamps", "60 frames"]),
    "poses on their side": (
        text([T_S, X, Y, ZERO, ZERO, ZERO, np.sin(THETA / 2 + 0.785), np.cos(THETA / 2 + 0.785)]),
        ["sideways"]),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_can_be_read_in_two_ways_is_one_line_and_nothing_is_written(
    name, plain, tmp_path, capsys
):
    body, words = REFUSED[name]
    (plain / "o.txt").write_text(body)
    before = sorted(tmp_path.iterdir())
    assert convert(plain, tmp_path / "out") == 3
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    assert [word for word in ("o.txt", *words) if word not in line] == []
    assert sorted(tmp_path.iterdir()) == before


# The other files: poses of map and query, stamps, descriptors


OTHERS = {
    "map in nanoseconds": ("m.txt", text([whole(10**9), *TUM[1:]]), [], "m.txt: stamps are recog"),
    "query in milliseconds": ("q.txt", text([whole(10**3), *TUM[1:]]), [], "q.txt: stamps are"),
    "query with names": (
        "q.txt", text([T_S, X, Y, DEG], ";", "stamp;px;py;yaw_deg"), [], "stamp = t_s, px = x_m"),
    "map with w first": (
        "m.txt", text([T_S, X, Y, ZERO, QW, ZERO, ZERO, QZ]), ["--quaternion", "wxyz"],
        "o.txt: quaternions stay xyzw"),
    "a query row twice": ("q.txt", twice(text(TUM)), [], "q.txt: 1 row repeats a stamp"),
    "a map row twice": ("m.txt", twice(text(TUM)), [], "m.txt: 1 row repeats a stamp"),
    "query rows late, views by time": (
        "q.txt", swapped(text(TUM)), ["--descriptors-order", "time"], "q.txt: 1 row came late"),
    "positions alone": ("m.txt", text([X, Y], ",", "x,y"), [], "m.txt: headings are derived"),
    "no stamps in the query": (
        "q.txt", text([X, Y, THETA], ",", "x,y,theta"), [], "as the query frames have no time"),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_files_of_poses_are_read_as_those_of_odometry(name, plain, tmp_path, capsys):
    file, body, flags, said = OTHERS[name]
    (plain / file).write_text(body)
    assert convert(plain, tmp_path / "out", *flags) == 0
    assert said in capsys.readouterr().err
    assert moved(tmp_path / "out")[:, 1:] == pytest.approx(STEPS, abs=2e-4)
    for side in ("map/poses.csv", "truth/query_poses.csv"):
        got = np.loadtxt(tmp_path / "out" / side, delimiter=",", skiprows=1)
        assert got[:, 1:3] == pytest.approx(XYT[:, :2], abs=1e-4)


@pytest.mark.parametrize("order", ["rows", "time"])
def test_late_rows_of_images_ask_what_the_descriptors_follow(order, plain, tmp_path, capsys):
    (plain / "q.txt").write_text(swapped(text(TUM)))
    assert convert(plain, tmp_path / "out") == 3
    line = capsys.readouterr().err
    assert "qv.npy: data rows 21 and 22 of its poses came late" in line
    assert "--descriptors-order" in line
    assert not (tmp_path / "out").exists()
    assert convert(plain, tmp_path / "out", "--descriptors-order", order) == 0
    rows = np.load(plain / "qv.npy")
    if order == "rows":
        rows[[20, 21]] = rows[[21, 20]]
    assert np.array_equal(np.load(tmp_path / "out/query/descriptors.npy"), rows)


TIMES = {
    "seconds": (text([T_S - START_S]), "its clock is 1700005000"),
    "nanoseconds": (text([whole(10**9)]), "t.txt: stamps are recognised as nanoseconds"),
    "a name": (text([T_S], header="timestamp"), "read as kitti"),
    "names of images": (text([T_S, [f"rgb/{t:.3f}.png" for t in T_S]]), "read as kitti"),
    "row numbers": (text([COUNT, T_S], ","), "read as kitti"),
}


@pytest.mark.parametrize("name", TIMES)
def test_stamps_in_a_file_of_their_own(name, plain, tmp_path, capsys):
    body, said = TIMES[name]
    (plain / "t.txt").write_text(body)
    (plain / "o.txt").write_text(text(matrices()))
    assert convert(plain, tmp_path / "out", "--times", "t.txt") == 0
    assert said in capsys.readouterr().err
    assert moved(tmp_path / "out")[:, 1:] == pytest.approx(STEPS, abs=2e-4)


ROWS = np.random.default_rng(7).normal(size=(N, 8)).astype(np.float32)
UNIT = ROWS / np.linalg.norm(ROWS, axis=1, keepdims=True)
VIEWS = {
    "(N, 1, D)": (ROWS[:, None], ROWS, "(60, 1, 8) is read as (60, 8)"),
    "(1, N, D)": (ROWS[None], ROWS, "(1, 60, 8) is read as (60, 8)"),
    "(N, D, 1, 1)": (ROWS[:, :, None, None], ROWS, "(60, 8, 1, 1) is read as (60, 8)"),
    "(D, N)": (ROWS.T, ROWS, "(8, 60) is read as (60, 8)"),
    "(1, D, N)": (ROWS.T[None], ROWS, "(1, 8, 60) is read as (60, 8)"),
    "Fortran order": (np.asfortranarray(ROWS), ROWS, "map: 60 frames"),
    "big-endian": (ROWS.astype(">f4"), ROWS, "big-endian numbers are read as float32"),
    "float64": (ROWS.astype(float), ROWS, "map: 60 frames"),
    "int8": ((UNIT * 127).round().astype(np.int8), None, "int8 numbers are read as float32"),
    "uint8": ((UNIT * 60 + 128).round().astype(np.uint8), None, "uint8 numbers are read"),
    "big-endian integers": ((UNIT * 3e4).round().astype(">i2"), None, ">i2 numbers are read"),
    "integers across": ((UNIT * 127).round().astype(np.int8).T, None, "(8, 60) is read as (60, 8)"),
}


@pytest.mark.parametrize("name", VIEWS)
def test_descriptors_of_any_shape_and_kind(name, plain, tmp_path, capsys):
    stored, want, said = VIEWS[name]
    np.save(plain / "mv.npy", stored)
    assert convert(plain, tmp_path / "out") == 0
    assert said in capsys.readouterr().err
    got = np.load(tmp_path / "out/map/descriptors.npy")
    assert got.dtype == np.float32
    if want is None:
        rows = stored.T if stored.shape[0] == 8 else stored
        want = rows / np.linalg.norm(rows.astype(float), axis=1, keepdims=True)
    assert got == pytest.approx(want, abs=1e-6)


@pytest.mark.parametrize("shape", [(60, 4, 8), (8, 61), (60,)])
def test_descriptors_that_are_none_are_refused(shape, plain, tmp_path, capsys):
    np.save(plain / "mv.npy", np.ones(shape, np.float32))
    assert convert(plain, tmp_path / "out") == 3
    line = capsys.readouterr().err.strip()
    assert "mv.npy" in line
    assert "\n" not in line


def test_the_only_array_of_an_archive_may_have_any_name(plain, tmp_path):
    np.savez(plain / "a.npz", features=ROWS[:, None])
    assert convert(plain, tmp_path / "out", "--map-descriptors", "a.npz") == 0
    assert np.array_equal(np.load(tmp_path / "out/map/descriptors.npy"), ROWS)


ARRAYS = {
    "matrices of a vehicle": (np.stack([
        np.cos(THETA), -np.sin(THETA), ZERO, X, np.sin(THETA), np.cos(THETA), ZERO, Y, ZERO, ZERO,
        ZERO + 1, ZERO, ZERO, ZERO, ZERO, ZERO + 1], 1).reshape(N, 4, 4), "into the plane xy"),
    "matrices of a camera": (np.stack(matrices(), 1).reshape(N, 3, 4), "into the plane xz"),
    "tum": (np.stack(TUM, 1), "o.npy"),
    "w first": (np.stack([T_S, X, Y, ZERO, QW, ZERO, ZERO, QZ], 1), "quaternions are read as wxyz"),
    "an axis of one": (XYT[:, None], "(60, 1, 3) is read as (60, 3)"),
    "big-endian": (np.c_[T_S, XYT].astype(">f8"), "o.npy"),
    "milliseconds": (np.c_[T_S * 1e3, XYT], "recognised as milliseconds"),
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_of_poses_of_any_shape(name, plain, tmp_path, capsys):
    array, said = ARRAYS[name]
    np.save(plain / "o.npy", array)
    flags = "--odometry", "o.npy", "--odometry-kind", "poses"
    assert convert(plain, tmp_path / "out", *flags) == 0
    assert said in capsys.readouterr().err
    assert moved(tmp_path / "out")[:, 1:] == pytest.approx(STEPS, abs=2e-4)


# A folder that grows


def grown(out, *words):
    return main(["convert", "files", str(out), *map(str, words)])


def test_query_and_truth_are_added_to_a_map(plain, tmp_path, capsys):
    out, whole_out = tmp_path / "out", tmp_path / "whole"
    for name in ("m.txt", "q.txt", "o.txt"):
        # UTM coordinates: the origin has to be remembered.
        body = text([T_S, X + 350_000.0, Y + 4_000_000.0, *TUM[3:]])
        (plain / name).write_text(body)
    assert grown(out, "--map-poses", plain / "m.txt", "--map-descriptors", plain / "mv.npy") == 0
    assert not (out / "query").exists()
    added = "--odometry", plain / "o.txt", "--query-descriptors", plain / "qv.npy"
    assert grown(out, *added) == 0
    assert "added query/odometry.csv, query/descriptors.npy" in capsys.readouterr().err
    assert not (out / "truth").exists()
    assert grown(out, "--query-poses", plain / "q.txt") == 0
    assert "added truth/query_poses.csv" in capsys.readouterr().err
    assert convert(plain, whole_out) == 0
    for name in ("map/poses.csv", "query/odometry.csv", "truth/query_poses.csv",
                 "map/descriptors.npy", "query/descriptors.npy"):  # fmt: skip
        assert (out / name).read_bytes() == (whole_out / name).read_bytes(), name
    capsys.readouterr()
    assert main(["inspect", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"taojax audit {out}")


def test_nothing_that_is_there_is_overwritten(plain, tmp_path, capsys):
    out = tmp_path / "out"
    assert convert(plain, out) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    capsys.readouterr()
    for words, there in (
        (("--query-poses", plain / "q.txt"), "truth/query_poses.csv"),
        (
            ("--odometry", plain / "o.txt", "--query-descriptors", plain / "qv.npy"),
            "query/odometry.csv",
        ),
        (("--map-poses", plain / "m.txt", "--odometry", plain / "o.txt"), "map/poses.csv"),
    ):
        assert grown(out, *words) == 3
        line = capsys.readouterr().err.strip()
        assert there in line
        assert "\n" not in line
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_truth_at_any_rate_is_brought_to_the_frames(plain, tmp_path, capsys):
    out = tmp_path / "out"
    query = "--odometry", plain / "o.txt", "--query-descriptors", plain / "qv.npy"
    views = "--map-descriptors", plain / "mv.npy"
    assert grown(out, "--map-poses", plain / "m.txt", *views, *query) == 0
    dense = np.linspace(T_S[0] - 1, T_S[-1] + 1, 20 * N)
    rows = [dense, np.interp(dense, T_S, X), np.interp(dense, T_S, Y), np.interp(dense, T_S, THETA)]
    (plain / "gps.csv").write_text(text(rows, ",", "time,east,north,yaw"))
    assert grown(out, "--query-poses", plain / "gps.csv") == 0
    got = np.loadtxt(out / "truth/query_poses.csv", delimiter=",", skiprows=1)
    assert got == pytest.approx(np.c_[T_S, XYT], abs=2e-2)
    (out / "truth/query_poses.csv").unlink()
    (plain / "gps.csv").write_text(text([c[:300] for c in rows], ",", "time,east,north,yaw"))
    capsys.readouterr()
    assert grown(out, "--query-poses", plain / "gps.csv") == 3
    assert "gps.csv: knows " in capsys.readouterr().err


def test_without_a_map_nothing_can_be_added(plain, tmp_path, capsys):
    assert grown(tmp_path / "none", "--query-poses", plain / "q.txt") == 2
    assert "give --map-poses" in capsys.readouterr().err
