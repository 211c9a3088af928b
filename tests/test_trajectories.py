"""Files of poses: every variant gives back the drive that was written, every fault its row."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taojax.datasets.reading import Reading
from taojax.datasets.trajectories import read_trajectory as read_drive
from taojax.datasets.trajectories import stamps_s
from taojax.datasets.trajectory import integrate, motions
from taojax.errors import InputError
from taojax.files.specs import load_spec

START_S = 1_600_000_000.0
N = 40


def read_trajectory(path, kind, **told):
    """Return the poses alone; what is said about them has tests of its own."""
    return read_drive(path, kind, Reading(**told)).poses


def left_turning_drive():
    """A metre and a fraction of a turn to the left at every step, from a pose that is not zero."""
    steps = np.tile([[1.0, 0.02, 0.05]], (N, 1))
    drive = integrate(steps)
    c, s = np.cos(0.7), np.sin(0.7)
    xy = drive[:, :2] @ np.array([[c, s], [-s, c]]) + [352_800.0, 4_025_530.0]
    return np.c_[xy, np.angle(np.exp(1j * (drive[:, 2] + 0.7)))]


DRIVE = left_turning_drive()
T_S = START_S + 0.1 * np.arange(N)


def yaw_quaternions():
    """(N, 4) x, y, z, w of a z-up body."""
    half = DRIVE[:, 2] / 2
    return np.c_[np.zeros((N, 2)), np.sin(half), np.cos(half)]


def camera_matrices():
    """(N, 3, 4) of a camera looking along its z, x to the right, y down: x = -left, z = forward."""
    c, s, zero, one = np.cos(DRIVE[:, 2]), np.sin(DRIVE[:, 2]), np.zeros(N), np.ones(N)
    right, down, ahead = (c, zero, s), (zero, one, zero), (-s, zero, c)
    place = (-DRIVE[:, 1], zero + 1.6, DRIVE[:, 0])
    return np.stack([np.stack(column, axis=1) for column in (right, down, ahead, place)], axis=2)


def vehicle_matrices():
    """(N, 3, 4) of a body with z up and x forward."""
    rotation = Rotation.from_quat(yaw_quaternions()).as_matrix()
    return np.concatenate([rotation, np.c_[DRIVE[:, :2], np.zeros(N)][:, :, None]], axis=2)


def texts(rows):
    return [[repr(float(cell)) for cell in row] for row in rows]


def stamps(scale):
    return [str(round(START_S) * scale + i * scale // 10) for i in range(N)]


def tum_lines():
    rows = texts(np.c_[T_S, DRIVE[:, :2], np.zeros(N), yaw_quaternions()])
    return [" ".join(row) for row in rows]


def kitti_lines(*, frames=False, plane="xz"):
    matrices = camera_matrices() if plane == "xz" else vehicle_matrices()
    rows = [" ".join(row) for row in texts(matrices.reshape(N, 12))]
    return [f"{i} {row}" for i, row in enumerate(rows)] if frames else rows


def euroc_lines(width=17):
    x, y, z, w = yaw_quaternions().T
    cells = texts(np.c_[DRIVE[:, :2], np.zeros(N), w, x, y, z, np.ones((N, 9))])
    rows = zip(stamps(10**9), cells, strict=True)
    return [",".join([stamp, *row[: width - 1]]) for stamp, row in rows]


def g2o_lines(tag="VERTEX_SE3:QUAT", first=0):
    flat = texts(np.c_[DRIVE[:, :2], np.zeros(N), yaw_quaternions()])
    rows = texts(DRIVE) if tag == "VERTEX_SE2" else flat
    return [" ".join([tag, str(first + i), *row]) for i, row in enumerate(rows)]


def csv_lines():
    return ["t_s,x_m,y_m,theta_rad", *(",".join(row) for row in texts(np.c_[T_S, DRIVE]))]


LINES = {
    "tum": tum_lines,
    "kitti": lambda: kitti_lines(frames=True),
    "euroc": euroc_lines,
    "g2o": g2o_lines,
    "csv": csv_lines,
}
SEPARATOR = {"tum": " ", "kitti": " ", "euroc": ",", "g2o": " ", "csv": ","}


def write(path, lines, *, end="\n", start=b"", tail="\n"):
    path.write_bytes(start + (end.join(lines) + tail).encode())
    return path


def check(drive, t_s=T_S):
    """Hold a drive against the one that was written, in whatever frame its file has."""
    np.testing.assert_allclose(drive.t_s, t_s, atol=1e-6)
    np.testing.assert_allclose(motions(drive.xyt), motions(DRIVE), atol=1e-8)
    assert drive.xyt.dtype == drive.t_s.dtype == np.float64
    assert (motions(drive.xyt)[1:, 2] > 0).all(), "a turn to the left is a positive yaw"


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize(
    "style",
    [
        {},
        {"end": "\r\n", "tail": "\r\n"},
        {"start": b"\xef\xbb\xbf"},
        {"tail": "\n\n  \n\n"},
        {"tail": ""},
    ],
    ids=["plain", "crlf", "bom", "trailing-blanks", "no-last-newline"],
)
def test_a_drive_survives_its_file(tmp_path, kind, style):
    path = write(tmp_path / "poses", LINES[kind](), **style)
    counted = kind in ("kitti", "g2o")
    check(read_trajectory(path, kind), np.arange(float(N)) if counted else T_S)


@pytest.mark.parametrize("frames", [False, True])
@pytest.mark.parametrize("plane", ["xz", "xy"])
@pytest.mark.parametrize("has_times", [False, True])
def test_kitti_rows_have_twelve_or_thirteen_cells_in_either_plane(
    tmp_path, frames, plane, has_times
):
    path = write(tmp_path / "00.txt", kitti_lines(frames=frames, plane=plane))
    times = tmp_path / "times.txt"
    times.write_text("".join(f"{0.1 * i:.6e}\n" for i in range(N)))
    drive = read_trajectory(path, "kitti", times=times if has_times else None, plane=plane)
    check(drive, (0.1 if has_times else 1.0) * np.arange(N))


def test_the_camera_plane_is_right_handed_and_starts_along_x(tmp_path):
    path = write(tmp_path / "00.txt", kitti_lines())
    np.testing.assert_allclose(read_trajectory(path, "kitti").xyt, DRIVE, atol=1e-8)


def test_a_kitti_frame_number_picks_its_own_stamp(tmp_path):
    path = write(tmp_path / "00.txt", kitti_lines(frames=True)[::2])
    times = write(tmp_path / "times.txt", [f"{i / 8:.6e}" for i in range(N)])
    drive = read_trajectory(path, "kitti", times=times)
    np.testing.assert_array_equal(drive.t_s, np.arange(0, N, 2) / 8)
    np.testing.assert_array_equal(read_trajectory(path, "kitti").t_s, np.arange(0.0, N, 2))


def test_times_that_do_not_pair_with_the_poses_are_refused(tmp_path):
    times = write(tmp_path / "times.txt", [f"{i / 8:.6e}" for i in range(N - 5)])
    path = write(tmp_path / "00.txt", kitti_lines())
    with pytest.raises(InputError, match=r"times\.txt: 35 stamps for the 40 poses of 00\.txt; "):
        read_trajectory(path, "kitti", times=times)
    path = write(tmp_path / "00.txt", kitti_lines(frames=True))
    with pytest.raises(InputError, match=r"row 36: frame 35 has no line in times\.txt"):
        read_trajectory(path, "kitti", times=times)
    lines = [f"{0.5 * i} {row}" for i, row in enumerate(kitti_lines())]
    with pytest.raises(InputError, match=r"row 2: frame 0\.5 has no line in times\.txt"):
        read_trajectory(write(tmp_path / "01.txt", lines), "kitti", times=times)
    path = write(tmp_path / "02.txt", tum_lines())
    with pytest.raises(InputError, match=r"poses of 02\.txt carry their own stamps"):
        read_trajectory(path, "tum", times=times)


def test_comments_and_headers_are_passed_over(tmp_path):
    head = ["# timestamp tx ty tz qx qy qz qw", "#"]
    check(read_trajectory(write(tmp_path / "a", [*head, *tum_lines()]), "tum"))
    names = (
        "timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
        "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x, "
        "b_w_RS_S_y, b_w_RS_S_z, b_a_RS_S_x, b_a_RS_S_y, b_a_RS_S_z"
    )
    for head in (f"#{names}", names):
        check(read_trajectory(write(tmp_path / "b", [head, *euroc_lines()]), "euroc"))


@pytest.mark.parametrize("width", range(8, 18))
def test_euroc_rows_have_eight_to_seventeen_columns(tmp_path, width):
    check(read_trajectory(write(tmp_path / "data.csv", euroc_lines(width)), "euroc"))


def test_euroc_stamps_may_count_from_the_start_of_the_log(tmp_path):
    rows = [line.split(",", 1)[1] for line in euroc_lines(8)]
    lines = [f"{i * 10**8},{row}" for i, row in enumerate(rows)]
    drive = read_trajectory(write(tmp_path / "data.csv", lines), "euroc")
    np.testing.assert_allclose(drive.t_s, 0.1 * np.arange(N))


@pytest.mark.parametrize("tag", ["VERTEX_SE2", "VERTEX_SE3:QUAT"])
def test_a_graph_gives_its_pose_vertices_and_nothing_else(tmp_path, tag):
    edges = ["FIX 0", "VERTEX_TRACKXYZ 900 1 2 3", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", ""]
    drive = read_trajectory(write(tmp_path / "a.g2o", [*edges, *g2o_lines(tag, 7), *edges]), "g2o")
    check(drive, 7.0 + np.arange(N))


def test_vertex_symbols_become_row_numbers(tmp_path):
    path = write(tmp_path / "a.g2o", g2o_lines(first=ord("x") << 56))
    check(read_trajectory(path, "g2o"), np.arange(float(N)))


def test_tilt_of_the_body_does_not_turn_its_heading(tmp_path):
    tilted = Rotation.from_euler("ZYX", np.c_[DRIVE[:, 2], np.full((N, 2), 0.2)])
    rows = np.c_[T_S, DRIVE[:, :2], np.zeros(N), tilted.as_quat()]
    check(read_trajectory(write(tmp_path / "a", [" ".join(row) for row in texts(rows)]), "tum"))


def faulty(kind, fault):
    """Return the bytes of a file with one fault, and the row that has it."""
    lines, cut = LINES[kind](), SEPARATOR[kind]
    cells = lines[4].split(cut)
    if fault == "nan":
        lines[4] = cut.join([*cells[:3], "nan", *cells[4:]])
    elif fault == "infinite":
        lines[4] = cut.join([*cells[:2], "inf", *cells[3:]])
    elif fault == "word":
        lines[4] = cut.join([*cells[:2], "north", *cells[3:]])
    elif fault == "missing column":
        lines[4] = cut.join(cells[:-1])
    return "\n".join(lines).encode(), 5


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("fault", ["nan", "infinite", "word", "missing column"])
def test_a_fault_is_named_by_file_row_and_fix(tmp_path, kind, fault):
    path = tmp_path / "poses.txt"
    raw, row = faulty(kind, fault)
    path.write_bytes(raw)
    with pytest.raises(InputError) as caught:
        read_trajectory(path, kind)
    message = str(caught.value)
    assert message.startswith(f"{path}: row {row}")
    assert "; " in message
    assert "\n" not in message


@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (b"", "empty|vertices"),
        (b"\n\n", "empty|vertices"),
        (gzip.compress(b"1 2 3"), "gunzip"),
        ("1 2 3\n".encode("utf-16"), "not UTF-8"),
        (b"\x00\x01\x02", "row 1|vertices|cells"),
    ],
    ids=["empty", "blank", "gzip", "utf-16", "binary"],
)
def test_what_is_no_text_of_poses_is_refused(tmp_path, kind, raw, said):
    path = tmp_path / "poses.txt"
    path.write_bytes(raw)
    with pytest.raises(InputError, match=said):
        read_trajectory(path, kind)
    with pytest.raises(InputError, match="no such file"):
        read_trajectory(tmp_path / "absent", kind)


@pytest.mark.parametrize("kind", LINES)
def test_one_pose_is_no_drive(tmp_path, kind):
    lines = LINES[kind]()[: 2 if kind == "csv" else 1]
    with pytest.raises(InputError, match="at least"):
        read_trajectory(write(tmp_path / "poses", lines), kind)


@pytest.mark.parametrize("kind", ["tum", "csv"])
@pytest.mark.parametrize(
    ("scale", "unit"), [(10**9, "nanoseconds"), (10**6, "microseconds"), (10**3, "milliseconds")]
)
def test_stamps_that_cannot_be_seconds_are_read_in_their_unit(tmp_path, kind, scale, unit):
    lines, cut = LINES[kind](), SEPARATOR[kind]
    head, rows = lines[: kind == "csv"], lines[kind == "csv" :]
    rows = [
        cut.join([s, line.split(cut, 1)[1]]) for s, line in zip(stamps(scale), rows, strict=True)
    ]
    path = write(tmp_path / "poses", ["# a comment", *rows] if kind == "tum" else [*head, *rows])
    drive = read_drive(path, kind)
    check(drive.poses)
    assert f"poses: stamps are recognised as {unit}" in drive.notes


@pytest.mark.parametrize(("scale", "unit"), [(10**6, "microseconds"), (10**3, "milliseconds")])
def test_euroc_stamps_in_another_unit_are_read_and_said(tmp_path, scale, unit):
    rows = [line.split(",", 1)[1] for line in euroc_lines(8)]
    lines = [f"{stamp},{row}" for stamp, row in zip(stamps(scale), rows, strict=True)]
    drive = read_drive(write(tmp_path / "data.csv", lines), "euroc")
    check(drive.poses)
    assert f"data.csv: stamps are recognised as {unit}" in drive.notes


def test_euroc_stamps_of_no_known_unit_are_refused_with_the_flag(tmp_path):
    rows = [line.split(",", 1)[1] for line in euroc_lines(8)]
    lines = [f"{stamp},{row}" for stamp, row in zip(stamps(10), rows, strict=True)]
    with pytest.raises(InputError, match=r"row 1: .*add --time-unit"):
        read_trajectory(write(tmp_path / "data.csv", lines), "euroc")


def test_euroc_stamps_with_decimals_or_too_many_digits_are_refused(tmp_path):
    for stamp in ("1600000000.1", "1" * 30):
        lines = euroc_lines(8)
        lines[4] = ",".join([stamp, *lines[4].split(",")[1:]])
        with pytest.raises(InputError, match="row 5"):
            read_trajectory(write(tmp_path / "data.csv", lines), "euroc")


@pytest.mark.parametrize("per_s", [1, 10**3, 10**9])
def test_microseconds_are_told_from_their_neighbours(per_s):
    own = round(START_S) * 10**6 + np.arange(20) * 10**5
    np.testing.assert_allclose(stamps_s(Path("a"), own, "microseconds", str), own / 1e6)
    other = round(START_S) * per_s + np.arange(20) * max(per_s // 10, 1)
    with pytest.raises(InputError, match="not in microseconds"):
        stamps_s(Path("a"), other, "microseconds", str)


@pytest.mark.parametrize("kind", ["tum", "euroc", "g2o"])
def test_a_quaternion_far_from_unit_length_is_refused(tmp_path, kind):
    lines, cut = (euroc_lines(8) if kind == "euroc" else LINES[kind]()), SEPARATOR[kind]
    lines[4] = cut.join([*lines[4].split(cut)[:-3], "0.9", "0.9", "0.9"])
    with pytest.raises(InputError, match=r"row 5: the quaternion has length 1\.[568]"):
        read_trajectory(write(tmp_path / "poses", lines), kind)


def test_quaternions_of_four_decimals_are_near_enough(tmp_path):
    rows = np.c_[T_S, DRIVE[:, :2], np.zeros(N), yaw_quaternions().round(4)]
    drive = read_trajectory(write(tmp_path / "a", [" ".join(r) for r in texts(rows)]), "tum")
    np.testing.assert_allclose(motions(drive.xyt), motions(DRIVE), atol=1e-3)


def test_a_matrix_that_is_no_rotation_is_refused(tmp_path):
    lines = kitti_lines()
    lines[4] = " ".join(["0.5", *lines[4].split()[1:]])
    with pytest.raises(InputError, match=r"row 5: the first three columns are no rotation; store"):
        read_trajectory(write(tmp_path / "00.txt", lines), "kitti")
    mirrored = camera_matrices() * np.array([[[-1.0, 1.0, 1.0, 1.0]]])
    lines = [" ".join(row) for row in texts(mirrored.reshape(N, 12))]
    with pytest.raises(InputError, match=r"row 1: the first three columns are no rotation; store"):
        read_trajectory(write(tmp_path / "00.txt", lines), "kitti")
    columns_first = camera_matrices().transpose(0, 2, 1).reshape(N, 12)
    lines = [" ".join(row) for row in texts(columns_first)]
    with pytest.raises(InputError, match=r"row 1, column \w+: .*; store rotation matrices row by"):
        read_trajectory(write(tmp_path / "00.txt", lines), "kitti")


@pytest.mark.parametrize(
    ("kind", "lines", "plane"),
    [
        ("kitti", kitti_lines(plane="xy"), "xz"),
        ("kitti", kitti_lines(plane="xz"), "xy"),
        ("tum", tum_lines(), "xz"),
        ("euroc", euroc_lines(), "xz"),
        ("g2o", g2o_lines(), "xz"),
    ],
)
def test_the_wrong_plane_is_refused(tmp_path, kind, lines, plane):
    with pytest.raises(InputError, match="; try plane "):
        read_trajectory(write(tmp_path / "poses", lines), kind, plane=plane)


def test_a_straight_drive_along_the_optical_axis_is_out_of_the_ground_plane(tmp_path):
    rows = [f"{i} 0 0 {i} 0 0 0 1" for i in range(N)]
    path = write(tmp_path / "a", rows)
    np.testing.assert_allclose(read_trajectory(path, "tum", plane="xz").xyt[:, 0], np.arange(N))
    with pytest.raises(InputError, match="100% of the way leaves the plane xy; try plane xz"):
        read_trajectory(path, "tum")


def test_a_body_that_looks_sideways_is_refused(tmp_path):
    turned = Rotation.from_euler("z", DRIVE[:, 2:] + np.pi / 2).as_quat()
    rows = np.c_[T_S, DRIVE[:, :2], np.zeros(N), turned]
    with pytest.raises(InputError, match="moves sideways"):
        read_trajectory(write(tmp_path / "a", [" ".join(row) for row in texts(rows)]), "tum")


def test_a_forward_axis_that_stands_upright_is_refused(tmp_path):
    upright = np.tile(Rotation.from_euler("y", -np.pi / 2).as_quat(), (N, 1))
    rows = np.c_[T_S, DRIVE[:, :2], np.zeros(N), upright]
    with pytest.raises(InputError, match="row 1: the forward axis stands upright on the plane xy"):
        read_trajectory(write(tmp_path / "a", [" ".join(row) for row in texts(rows)]), "tum")


def test_a_robot_that_jitters_at_a_stop_has_poses_in_any_plane(tmp_path, rng):
    poses = np.tile([[5.0, 6.0, 0.0, 0.0, 0.0, 0.0, 1.0]], (N, 1))
    poses[:, 2] += rng.normal(0, 0.1, N)
    rows = np.c_[T_S, poses]
    path = write(tmp_path / "a", [" ".join(row) for row in texts(rows)])
    for plane in ("xy", "xz"):
        assert len(read_trajectory(path, "tum", plane=plane).t_s) == N


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"], "0 pose vertices"),
        ([*g2o_lines(), *g2o_lines("VERTEX_SE2", N)], "of 2 kinds"),
        ([*g2o_lines(), "VERTEX_SE3:QUAT"], f"row {N + 1}: 1 words where 9"),
        (["VERTEX_SE2 a 0 0 0", *g2o_lines("VERTEX_SE2")], "row 1: "),
    ],
)
def test_a_graph_without_a_drive_is_refused(tmp_path, lines, said):
    with pytest.raises(InputError, match=said):
        read_trajectory(write(tmp_path / "a.g2o", lines), "g2o")


@pytest.mark.parametrize("name", ["tum", "kitti", "euroc"])
def test_every_layout_of_a_spec_names_its_columns(name):
    spec = load_spec(name)
    named = {column["name"] for column in spec["columns"]}
    assert spec["description"]
    assert all(set(layout) <= named for layout in spec.get("layouts", []))
