"""`taojax convert sthereo`: sequences, frame lists, and twelve ways to be broken."""

import gzip

import foreign
import numpy as np
import pytest

from taojax.cli import main
from taojax.datasets.public_sets import check_sensors, read_frame_list, read_sthereo
from taojax.datasets.sessions import Matching
from taojax.errors import InputError
from taojax.files.tables import read_table
from taojax.runtime.observations import load_observations

CAMERA = "image/stereo_thermal_14_left"


@pytest.fixture
def pair(tmp_path):
    """Two sequences on one road, the query 1 m to the left of the map."""
    return foreign.sthereo(tmp_path / "map"), foreign.sthereo(tmp_path / "query", left_m=1.0)


def xyt(path, spec):
    table = read_table(path, spec)
    return np.stack([table[name] for name in ("x_m", "y_m", "theta_rad")], axis=1)


def test_a_pair_of_sequences_becomes_a_data_folder_that_loads(pair, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--simulate-descriptors", "--query-frames", "20"]
    assert main(["convert", "sthereo", *map(str, pair), str(out), *words]) == 0
    said = capsys.readouterr().err
    assert "58 of 58 frames have a pose within 0.5 s (interpolated)" in said
    assert f"taojax inspect {out}" in said

    t_s = foreign.stamps(58, 1.0, 0.13)
    origin = np.array([[*foreign.pose_at(t_s[0])[:2], 0.0]])
    mapped = xyt(out / "map/poses.csv", "map_poses")
    assert np.abs(mapped - (foreign.pose_at(t_s) - origin)).max() < 0.05
    query = xyt(out / "truth/query_poses.csv", "query_poses")
    kept = np.round(np.linspace(0, 57, 20)).astype(int)
    assert np.abs(query[:, :2] - (foreign.pose_at(t_s[kept], 1.0) - origin)[:, :2]).max() < 0.05

    seen = load_observations(out)
    assert len(seen.map_poses["t_s"]) == 58
    assert seen.t_s == pytest.approx(foreign.START_S + t_s[kept], abs=1e-6)
    notes = " ".join(seen.notes)
    assert "simulated odometry" in notes
    assert "simulated descriptors" in notes
    assert "query: 20 of 58 frames kept" in notes


def test_a_frame_lies_between_the_poses_around_it_or_at_the_nearest(pair):
    t_s = foreign.stamps(58, 1.0, 0.13)
    smooth = read_sthereo(pair[0]).poses
    nearest = read_sthereo(pair[0], matching=Matching(is_interpolated=False)).poses
    assert smooth.t_s == pytest.approx(foreign.START_S + t_s, abs=1e-6)
    assert np.abs(smooth.xyt - foreign.pose_at(t_s)).max() < 0.05
    row = np.round(t_s / 0.4) * 0.4
    assert np.abs(nearest.xyt - foreign.pose_at(row)).max() < 1e-5


def test_frames_without_a_pose_are_left_out_and_counted(pair):
    rows = foreign.sthereo_rows()
    foreign.write(pair[0] / "pose/global_pose.csv", rows[:50] + rows[75:])
    session = read_sthereo(pair[0])
    gone = 20.13, 29.13  # seconds, around the hole from 19.6 s to 30.0 s
    t_s = session.poses.t_s - foreign.START_S
    assert not np.any((t_s > gone[0] - 0.01) & (t_s < gone[1] + 0.01))
    assert len(session.frames) == 48
    assert "48 of 58 frames have a pose within 0.5 s" in session.notes[-1]


def test_too_few_frames_with_a_pose_are_refused_with_both_clocks(pair):
    rows = foreign.sthereo_rows()
    late = [[f"{float(row[0]) + 40.0:.6f}", *row[1:]] for row in rows]
    foreign.write(pair[0] / "pose/global_pose.csv", late)
    with pytest.raises(InputError, match=r"18 of 58 frames .* poses from 1630106875") as caught:
        read_sthereo(pair[0])
    assert "--least-matched" in str(caught.value)
    assert len(read_sthereo(pair[0], matching=Matching(least=0.3)).frames) == 18


@pytest.mark.parametrize(
    ("yaw", "degrees"), [(lambda yaw: yaw + 180.0, "180"), (lambda yaw: 90.0 - yaw, "")]
)
def test_a_yaw_that_is_not_the_direction_of_travel_is_replaced_and_said(pair, yaw, degrees):
    rows = [[*row[:6], f"{yaw(float(row[6])):.6f}"] for row in foreign.sthereo_rows()]
    foreign.write(pair[0] / "pose/global_pose.csv", rows)
    session = read_sthereo(pair[0])
    off = session.poses.xyt[:, 2] - foreign.pose_at(foreign.stamps(58, 1.0, 0.13))[:, 2]
    assert np.abs(np.angle(np.exp(1j * off))).max() < 0.15
    said = next(note for note in session.notes if "derived from positions" in note)
    assert f"{degrees} degrees off the direction of travel" in said


def test_a_sound_yaw_is_taken_as_it_is(pair):
    # Ten degrees beside the way: a camera that is mounted so, no other convention.
    rows = [[*row[:6], f"{float(row[6]) + 10.0:.6f}"] for row in foreign.sthereo_rows()]
    foreign.write(pair[0] / "pose/global_pose.csv", rows)
    session = read_sthereo(pair[0])
    off = session.poses.xyt[:, 2] - foreign.pose_at(foreign.stamps(58, 1.0, 0.13))[:, 2]
    assert np.degrees(np.angle(np.exp(1j * off))) == pytest.approx(10.0, abs=1.0)
    assert not any("direction of travel" in note for note in session.notes)


def test_repeated_rows_count_once(pair):
    rows = foreign.sthereo_rows()
    foreign.write(pair[0] / "pose/global_pose.csv", [*rows[:7], rows[6], rows[6], *rows[7:]])
    session = read_sthereo(pair[0])
    assert "2 repeated row(s) of global_pose.csv count once" in session.notes
    assert np.abs(session.poses.xyt - foreign.pose_at(foreign.stamps(58, 1.0, 0.13))).max() < 0.05


@pytest.mark.parametrize(
    "dialect",
    [{"header": "t,x,y,z,roll,pitch,yaw"}, *({"dialect": d} for d in ("crlf", "bom", "trailing"))],
)
def test_every_dialect_of_the_poses_reads_the_same(pair, dialect):
    plain = read_sthereo(pair[0])
    foreign.write(pair[0] / "pose/global_pose.csv", foreign.sthereo_rows(), **dialect)
    assert np.array_equal(read_sthereo(pair[0]).poses.xyt, plain.poses.xyt)


def test_local_poses_lose_their_odd_ends_and_say_what_is_not_known(pair):
    rows = foreign.sthereo_rows()
    local = [[row[0], f"{float(row[1]) - 352e3:.6f}", *row[2:]] for row in rows]
    odd = [["0.000000", "9e9", "0", "0", "0", "0", "0"]]
    foreign.write(pair[0] / "pose/local_pose.csv", [*odd, *local, *odd])
    session = read_sthereo(pair[0], is_local=True)
    assert session.poses.xyt[0, 0] < 1000.0
    assert "that the sequences share a frame is not known" in session.notes[0]
    local[6][0] = local[4][0]
    foreign.write(pair[0] / "pose/local_pose.csv", [*odd, *local, *odd])
    with pytest.raises(InputError, match="row 8: time runs backwards"):
        read_sthereo(pair[0], is_local=True)


def test_another_camera_is_chosen_by_its_folder_and_a_missing_one_names_those_there(tmp_path):
    foreign.sthereo(tmp_path / "a", camera="thermal8_left_clahe")
    assert len(read_sthereo(tmp_path / "a", camera="thermal8_left_clahe").frames) == 58
    with pytest.raises(InputError, match="there are thermal8_left_clahe"):
        read_sthereo(tmp_path / "a")


def test_a_packed_sequence_is_told_to_be_unpacked(tmp_path):
    (tmp_path / "a").mkdir()
    for name in ("image.tar", "pose.tar"):
        (tmp_path / "a" / name).touch()
    with pytest.raises(InputError, match=r"pose.tar is there; unpack it"):
        read_sthereo(tmp_path / "a")


@pytest.mark.parametrize("imu_columns", [17, 8])
def test_other_sensors_are_held_against_their_specs(pair, imu_columns, tmp_path, capsys):
    foreign.sensors(pair[0], imu_columns=imu_columns)
    assert check_sensors(pair[0]) == ("data_stamp.csv", "gps.csv", "inspva.csv", "xsens_imu.csv")
    assert check_sensors(pair[1]) == ()
    words = ["convert", "sthereo", *map(str, pair), str(tmp_path / "out"), "--simulate-descriptors"]
    assert main(words) == 0
    assert "specs: data_stamp.csv, gps.csv, inspva.csv, xsens_imu.csv" in capsys.readouterr().err


def test_descriptors_of_all_images_fit_though_some_have_no_pose(pair, tmp_path, rng):
    rows = foreign.sthereo_rows()
    foreign.write(pair[0] / "pose/global_pose.csv", rows[25:])
    views = [rng.normal(size=(58, 8)).astype(np.float32) for _ in pair]
    for name, array in zip(("map", "query"), views, strict=True):
        np.save(tmp_path / f"{name}.npy", array)
    out = tmp_path / "out"
    words = [
        "--map-descriptors",
        str(tmp_path / "map.npy"),
        "--query-descriptors",
        str(tmp_path / "query.npy"),
    ]
    assert main(["convert", "sthereo", *map(str, pair), str(out), *words]) == 0
    # Poses begin at 10 s: the ten frames before 9.5 s have none.
    assert np.array_equal(np.load(out / "map/descriptors.npy"), views[0][10:])
    assert np.array_equal(np.load(out / "query/descriptors.npy"), views[1])


def test_real_lines_of_frame_lists_load(shared, tmp_path):
    lists = [
        shared / "sthereo_excerpt" / f"kaist_{name}_excerpt.txt" for name in ("morning", "evening")
    ]
    session = read_sthereo(lists[0])
    assert session.frames[0] == "1630106835318041837.png"
    assert session.poses.xyt[0, :2] == pytest.approx(foreign.ORIGIN_M, abs=1e-6)
    assert np.diff(session.poses.t_s)[:2] == pytest.approx([0.100046, 19.999999], abs=1e-6)
    assert len(session.frames) == 10
    out = tmp_path / "out"
    assert main(["convert", "sthereo", *map(str, lists), str(out), "--simulate-descriptors"]) == 0
    seen = load_observations(out)
    assert len(seen.t_s) == 8
    assert any("frame list" in note for note in seen.notes)


def frame_list(path, rows):
    foreign.write(path, rows, separator=" ")
    return path


def test_a_frame_listed_twice_counts_once_and_never_with_two_positions(tmp_path):
    t_s = foreign.stamps(6, 1.0)
    rows = [
        [f"{foreign.ns(t + 0.01)}.png", f"{foreign.ns(t)}.png", f"{x:.6f}", f"{y:.6f}", "44.5"]
        for t, (x, y, _) in zip(t_s, foreign.pose_at(t_s), strict=True)
    ]
    path = frame_list(tmp_path / "list.txt", [*rows[:3], rows[2], *rows[3:]])
    session = read_frame_list(path)
    assert len(session.frames) == 6
    assert "1 repeated row(s)" in session.notes[0]
    other = [*rows[2][:2], *rows[3][2:]]
    frame_list(path, [*rows[:3], other, *rows[3:]])
    with pytest.raises(InputError, match="row 4: the stamp of the row before"):
        read_frame_list(path)
    frame_list(path, [*rows[:3], [rows[3][0], rows[3][1][:-7] + ".png", *rows[3][2:]]])
    with pytest.raises(InputError, match=r"row 4, column thermal: .* is not a stamp of 19 digits"):
        read_frame_list(path)


# Twelve ways to be broken: what is done to the map, and the file, row and fix that are named.


def edited(edit):
    def broken(folder):
        rows = foreign.sthereo_rows()
        edit(rows)
        foreign.write(folder / "pose/global_pose.csv", rows)

    return broken


def without_column(rows):
    rows[4] = rows[4][:6]


def in_nanoseconds(rows):
    for row in rows:
        row[0] = row[0].replace(".", "") + "000"


def backwards(rows):
    rows[9][0] = rows[3][0]


def not_a_number(rows):
    rows[6][2] = "nan"


def other_zone(rows):
    for row in rows[40:]:
        row[1] = f"{float(row[1]) + 450e3:.6f}"


def swapped(rows):
    for row in rows:
        row[1], row[2] = row[2], row[1]


def contradictory(rows):
    rows[5] = [rows[4][0], *rows[5][1:]]


def truncated_name(folder):
    name = sorted((folder / CAMERA).iterdir())[3]
    name.rename(name.with_name(name.name[5:]))


def swapped_degrees(folder):
    foreign.sensors(folder)
    path = folder / "sensor_data/gps.csv"
    cells = [line.split(",") for line in path.read_text().splitlines()]
    foreign.write(path, [[row[0], row[2], row[1], *row[3:]] for row in cells])


def emptied(folder):
    (folder / "pose/global_pose.csv").write_text("")


def zipped(folder):
    path = folder / "pose/global_pose.csv"
    path.write_bytes(gzip.compress(path.read_bytes()))


def zipped_beside(folder):
    path = folder / "pose/global_pose.csv"
    path.with_name("global_pose.csv.gz").write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()


def not_utf8(folder):
    path = folder / "pose/global_pose.csv"
    lines = path.read_bytes().split(b"\n")
    lines[2] += b"\xb0"
    path.write_bytes(b"\n".join(lines))


BROKEN = {
    "missing column": (edited(without_column), "global_pose.csv: row 5:", "columns are t_s,x_m"),
    "wrong unit": (edited(in_nanoseconds), "row 1, column t_s", "nanoseconds; convert"),
    "reversed time": (edited(backwards), "global_pose.csv: row 10:", "sort the rows by time"),
    "not a number": (edited(not_a_number), "row 7, column y_m", "remove the row or repair"),
    "mixed zones": (edited(other_zone), "row 41: jumps 450 km", "project all rows to one zone"),
    "swapped easting": (edited(swapped), "row 1, column x_m", "swap x and y"),
    "swapped lat/lon": (swapped_degrees, "gps.csv: row 1, column lat_deg", "swap the columns"),
    "truncated name": (truncated_name, "06838130000000.png: its name is not a", "restore the name"),
    "duplicate stamps": (edited(contradictory), "row 6: the stamp of", "keep one row per stamp"),
    "empty file": (emptied, "global_pose.csv: the file is empty", "expected the columns"),
    "gzip": (zipped, "global_pose.csv: is compressed with gzip", "unpack it first"),
    "gzip beside": (zipped_beside, "global_pose.csv.gz is there", "unpack it first"),
    "not UTF-8": (not_utf8, "global_pose.csv: line 3 is not UTF-8", "save it as plain CSV"),
}


def refused(capsys, tmp_path, words):
    """Run a conversion that must fail with one line and leave nothing; return the line."""
    out = tmp_path / "out"
    assert main(["convert", *words[:3], str(out), *words[3:]]) == 3
    line = capsys.readouterr().err.strip()
    assert line.startswith("taojax: ")
    assert "\n" not in line
    assert not out.exists()
    assert not list(tmp_path.glob(".out*"))
    return line


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_sequence_is_exit_3_with_file_row_and_fix(how, pair, tmp_path, capsys):
    breaks, where, fix = BROKEN[how]
    breaks(pair[0])
    line = refused(capsys, tmp_path, ["sthereo", *map(str, pair), "--simulate-descriptors"])
    assert where in line
    assert fix in line


def test_descriptors_of_the_other_endianness_are_read_and_said(pair, tmp_path, capsys, rng):
    views = rng.normal(size=(58, 8))
    np.save(tmp_path / "map.npy", views.astype(">f4"))
    np.save(tmp_path / "query.npy", views.astype(np.float32))
    words = [
        "--map-descriptors",
        str(tmp_path / "map.npy"),
        "--query-descriptors",
        str(tmp_path / "query.npy"),
    ]
    out = tmp_path / "out"
    assert main(["convert", "sthereo", *map(str, pair), str(out), *words]) == 0
    assert "map.npy: big-endian numbers are read as float32" in capsys.readouterr().err
    read = np.load(out / "map/descriptors.npy")
    assert np.allclose(read, np.load(out / "query/descriptors.npy"))
