"""Odometry from any source gives back the drive that made it, and says what it cannot know."""

import gzip
import sys

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from taojax.datasets.files import kind_of
from taojax.datasets.odometry import odometry_at, simulated
from taojax.datasets.odometry import read_odometry as read_drive
from taojax.datasets.reading import Reading
from taojax.datasets.simulate import WorldConfig
from taojax.datasets.trajectory import Trajectory, integrate, motions
from taojax.errors import InputError, MissingExtraError

N = 60
START_NS = 1_500_000_000 * 10**9
STEP_NS = 10**8


def read_odometry(path, kind, **told):
    """Return the poses alone; what is said about them has tests of its own."""
    return read_drive(path, kind, Reading(**told)).poses


def left_turning_steps():
    """Motion along a circle to the left, ever faster; row 0 is zero."""
    turn = np.full(N, 0.05)
    chord = np.linspace(0.5, 1.5, N) * np.sinc(turn / (2 * np.pi))
    steps = np.stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn], axis=1)
    steps[0] = 0.0
    return steps


STEPS = left_turning_steps()
DRIVE = integrate(STEPS)
STAMPS_NS = START_NS + STEP_NS * np.arange(N)
T_S = STAMPS_NS / 1e9


def check(drive, *, atol=1e-9):
    np.testing.assert_allclose(drive.t_s, T_S, atol=1e-6)
    np.testing.assert_allclose(motions(drive.xyt), STEPS, atol=atol)


def message(caught, path, said):
    """Hold an error against the house form: one line with file, fault and fix."""
    text = str(caught.value)
    assert text.startswith(str(path)), text
    assert said in text
    assert "; " in text
    assert "\n" not in text


# Steps: the contract's own odometry.


def steps_lines():
    rows = [",".join(repr(float(v)) for v in row) for row in np.c_[T_S, STEPS]]
    return ["t_s,dx_m,dy_m,dtheta_rad", *rows]


@pytest.mark.parametrize("style", [("\n", ""), ("\r\n", "\r\n\r\n")], ids=["lf", "crlf"])
@pytest.mark.parametrize("bom", [b"", b"\xef\xbb\xbf"], ids=["plain", "bom"])
def test_steps_survive_their_file(tmp_path, style, bom):
    path = tmp_path / "odometry.csv"
    path.write_bytes(bom + (style[0].join(steps_lines()) + style[1]).encode())
    check(read_odometry(path, "steps"))


@pytest.mark.parametrize(
    ("at", "own", "said"),
    [
        (4, "nan,0,0,0", "row 5, column t_s"),
        (4, "1500000000.2,0,0", "row 5: 3 cells where 4"),
        (4, "1400000000.0,0,0,0", "row 5: time runs backwards"),
        (4, "1500000000.2,0,0,0", "row 5: the stamp of row 4 with another pose"),
        (0, "t_s,ahead_m,dy_m,dtheta_rad", "row 1: header"),
        (60, "1500000005900000000,0,0,0", "row 61: stamp 1.5000000059e+18 is not of the unit"),
    ],
)
def test_a_faulty_step_is_named(tmp_path, at, own, said):
    path, lines = tmp_path / "odometry.csv", steps_lines()
    lines[at] = own
    path.write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        read_odometry(path, "steps")
    message(caught, path, said)


@pytest.mark.parametrize(
    "raw", [b"", gzip.compress(b"1"), "1,2\n".encode("utf-16")], ids=["empty", "gzip", "utf-16"]
)
@pytest.mark.parametrize("kind", ["steps", "robotcar-vo", "bag", "tum"])
def test_what_is_no_odometry_is_refused(tmp_path, kind, raw):
    path = tmp_path / ("a.bag" if kind == "bag" else "a.csv")
    path.write_bytes(raw)
    with pytest.raises(InputError) as caught:
        read_odometry(path, kind)
    message(caught, path, "")


def test_options_that_a_kind_does_not_have_are_refused(tmp_path):
    with pytest.raises(InputError, match="has its own stamps"):
        read_odometry(tmp_path, "steps", times=tmp_path)
    with pytest.raises(InputError, match="has no topics"):
        read_odometry(tmp_path, "tum", topic="/odom")


# Wheels: Complex Urban counters and gyro.

CALIBRATION = """Encoder calibrated parameter
Encoder resolution: 4096
Encoder left wheel diameter: 0.623479
Encoder right wheel diameter: 0.622806
Encoder wheel base: 1.52439
"""


def write_sequence(folder, *, calibration=CALIBRATION, gyro_sign=1.0, gyro_ns=STAMPS_NS):
    """Write a sequence whose counters have a resolution of half a millimetre, as the real ones."""
    way_m = np.cumsum(np.r_[0.0, np.linspace(0.5, 1.5, N)[1:]])
    yaw = np.cumsum(STEPS[:, 2])
    per_count = np.pi * np.array([0.623479, 0.622806]) / 4096
    sides_m = np.stack([way_m - yaw * 1.52439 / 2, way_m + yaw * 1.52439 / 2], axis=1)
    counts = np.round(sides_m / per_count).astype(int) + [1_000_000, 2_000_000]
    (folder / "sensor_data").mkdir(parents=True)
    (folder / "calibration").mkdir()
    encoder = [f"{t},{a},{b}" for t, (a, b) in zip(STAMPS_NS, counts, strict=True)]
    # Ten increments of the gyro to one row of the encoder, as at 1,000 and 100 Hz.
    fog = [
        f"{t - (9 - k) * (STEP_NS // 10)},1e-5,-1e-5,{gyro_sign * turn / 10!r}"
        for t, turn in zip(gyro_ns.tolist(), STEPS[:, 2].tolist(), strict=True)
        for k in range(10)
    ]
    (folder / "sensor_data/encoder.csv").write_text("\n".join(encoder) + "\n")
    (folder / "sensor_data/fog.csv").write_text("\n".join(fog) + "\n")
    if calibration is not None:
        (folder / "calibration/EncoderParameter.txt").write_text(calibration)
    return folder


def test_wheels_and_gyro_give_the_drive_to_the_resolution_of_the_counters(tmp_path):
    drive = read_odometry(write_sequence(tmp_path / "urban"), "wheels")
    check(drive, atol=3e-4)
    assert (motions(drive.xyt)[1:, 2] > 0).all()
    np.testing.assert_allclose(motions(drive.xyt)[:, 2], STEPS[:, 2], atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        CALIBRATION.replace("\n", "\r\n"),
        CALIBRATION.lower().replace(": ", " = "),
        CALIBRATION.replace("diameter: ", "diameter [m] : ").replace("wheel base", "wheelbase"),
        "\ufeff" + "\n".join(reversed(CALIBRATION.splitlines())),
    ],
    ids=["crlf", "lower", "units", "bom-reversed"],
)
def test_the_calibration_is_read_in_any_spelling(tmp_path, text):
    folder = write_sequence(tmp_path / "urban")
    wanted = read_odometry(folder, "wheels").xyt
    (folder / "calibration/EncoderParameter.txt").write_bytes(text.encode())
    np.testing.assert_array_equal(read_odometry(folder, "wheels").xyt, wanted)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "so the wheels' resolution, diameters and base are unknown; put"),
        (CALIBRATION.replace("Encoder wheel base: 1.52439", ""), "'Encoder wheel base'; add"),
        (
            CALIBRATION.replace("0.622806", "622.806"),
            "row 4: 'Encoder right wheel diameter' is 622",
        ),
        (CALIBRATION.replace("4096", "0"), "row 2: 'Encoder resolution' is 0, outside"),
        (CALIBRATION.replace("4096", "4.0.96"), "row 2: '4.0.96' is not a number"),
    ],
)
def test_a_missing_parameter_is_named_with_its_place(tmp_path, text, said):
    folder = write_sequence(tmp_path / "urban", calibration=text)
    with pytest.raises(InputError) as caught:
        read_odometry(folder, "wheels")
    message(caught, folder / "calibration/EncoderParameter.txt", said)


@pytest.mark.parametrize(
    ("sign", "said"),
    [
        (-1.0, "turns -1 times as far as the wheels; negate d_yaw"),
        (180 / np.pi, "looks like degrees"),
        (5.0, "turns 5 times as far"),
    ],
)
def test_a_gyro_that_turns_otherwise_than_the_wheels_is_refused(tmp_path, sign, said):
    folder = write_sequence(tmp_path / "urban", gyro_sign=sign)
    with pytest.raises(InputError) as caught:
        read_odometry(folder, "wheels")
    message(caught, folder / "sensor_data/fog.csv", said)


def test_encoder_rows_outside_the_gyro_are_left_out_unless_they_are_most(tmp_path):
    folder = write_sequence(tmp_path / "a", gyro_ns=STAMPS_NS + 10 * STEP_NS)
    drive = read_odometry(folder, "wheels")
    np.testing.assert_allclose(drive.t_s, T_S[10:], atol=1e-6)
    folder = write_sequence(tmp_path / "b", gyro_ns=STAMPS_NS + 10**12)
    with pytest.raises(InputError) as caught:
        read_odometry(folder, "wheels")
    message(caught, folder / "sensor_data/fog.csv", "covers 0% of encoder.csv (1500000999")


@pytest.mark.parametrize(
    ("name", "at", "own", "said"),
    [
        ("encoder", 4, "1500000000400000000,99000000,2000000", "row 5: a wheel runs at"),
        ("encoder", 4, "1500000000400000000,1000000", "row 5: 2 cells where 3"),
        ("encoder", 4, "1500000000400000000,nan,1", "row 5, column left"),
        ("encoder", 4, "1500000000300000000,1,1", "row 5: stamp_ns is that of the row before"),
        ("encoder", 4, "1400000000300000000,1,1", "row 5: stamp_ns runs backwards"),
        ("encoder", 4, "1500000000.4,1,1", "row 5, column stamp_ns"),
        ("fog", 4, "1500000000000000000,0,0", "row 5: 3 cells where 4"),
        ("fog", 4, "1400000000000000000,0,0,0", "row 5: stamp_ns runs backwards"),
        ("fog", 4, "1500000000000000000,0,0,90", "row 5, column d_yaw"),
    ],
)
def test_a_faulty_wheel_row_is_named(tmp_path, name, at, own, said):
    folder = write_sequence(tmp_path / "urban")
    path = folder / f"sensor_data/{name}.csv"
    lines = path.read_text().splitlines()
    lines[at] = own
    path.write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        read_odometry(folder, "wheels")
    message(caught, path, said)
    path.unlink()
    with pytest.raises(InputError, match="no such file"):
        read_odometry(folder, "wheels")


def test_counters_stamped_in_microseconds_are_refused(tmp_path):
    folder = write_sequence(tmp_path / "urban")
    path = folder / "sensor_data/encoder.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("".join(f"{int(t) // 1000},{a},{b}\n" for t, a, b in rows))
    with pytest.raises(InputError) as caught:
        read_odometry(folder, "wheels")
    message(caught, path, f"row {N}: stamp 1500000005900000 is not in nanoseconds, it looks like m")


# RobotCar: relative poses, x forward, y right, z down.

VO_HEADER = "source_timestamp,destination_timestamp,x,y,z,roll,pitch,yaw"


def vo_lines(*, later_first=True):
    """A left turn in a frame whose y points right and z down: y and yaw are negative."""
    stamps = (STAMPS_NS // 1000).tolist()
    rows = []
    for before, behind, (dx, dy, turn) in zip(stamps, stamps[1:], STEPS[1:].tolist(), strict=False):
        pair = (behind, before) if later_first else (before, behind)
        rows.append(f"{pair[0]},{pair[1]},{dx!r},{-dy!r},0.01,0.001,-0.001,{-turn!r}")
    return rows


@pytest.mark.parametrize("later_first", [True, False])
@pytest.mark.parametrize("newest_first", [True, False])
def test_robotcar_rows_chain_in_either_order(tmp_path, later_first, newest_first):
    rows = vo_lines(later_first=later_first)
    path = tmp_path / "vo.csv"
    path.write_text("\r\n".join([VO_HEADER, *(rows[::-1] if newest_first else rows), "", ""]))
    drive = read_odometry(path, "robotcar-vo")
    check(drive)
    assert (motions(drive.xyt)[1:, 1:] > 0).all(), "left is positive"


@pytest.mark.parametrize("newest_first", [True, False])
def test_a_row_missing_from_the_chain_is_named_with_its_stamps(tmp_path, newest_first):
    rows = vo_lines()
    del rows[10]
    path = tmp_path / "vo.csv"
    path.write_text("\n".join([VO_HEADER, *(rows[::-1] if newest_first else rows)]))
    with pytest.raises(InputError) as caught:
        read_odometry(path, "robotcar-vo")
    here, there = ("row 49", "row 50") if newest_first else ("row 12", "row 11")
    message(caught, path, f"{here}: begins at 1500000001100000, but {there} ends at 15000000010")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: [*rows[:5], rows[3], *rows[6:]], "row 7: begins at"),
        (lambda rows: [*rows[:5], rows[4], *rows[5:]], "row 7: begins at"),
        (lambda rows: [*rows[:5], swapped(rows[5]), *rows[6:]], "row 7: its two stamps are"),
        (lambda rows: edited(rows, 4, "nan"), "row 7, column z"),
        (lambda rows: edited(rows, 7, "57.3"), "row 7, column yaw"),
        (lambda rows: [row.rsplit(",", 1)[0] for row in rows], "row 2: 7 cells where 8"),
        (lambda rows: [rescaled(row, 1e3) for row in rows], "microseconds, it looks like nano"),
        (lambda rows: [rescaled(row, 1e-3) for row in rows], "microseconds, it looks like milli"),
        (lambda rows: [inverted(row) for row in rows], "m backwards in all"),
        (lambda rows: [], "0 data row(s)"),
    ],
)
def test_a_faulty_vo_row_is_named(tmp_path, change, said):
    path = tmp_path / "vo.csv"
    path.write_text("\n".join([VO_HEADER, *change(vo_lines())]))
    with pytest.raises(InputError) as caught:
        read_odometry(path, "robotcar-vo")
    message(caught, path, said)


def swapped(row):
    source, destination, rest = row.split(",", 2)
    return ",".join([destination, source, rest])


def rescaled(row, factor):
    source, destination, rest = row.split(",", 2)
    scaled = [round(int(stamp) * factor) for stamp in (source, destination)]
    return f"{scaled[0]},{scaled[1]},{rest}"


def inverted(row):
    cells = row.split(",")
    return ",".join([*cells[:2], repr(-float(cells[2])), *cells[3:]])


def edited(rows, column, text):
    cells = rows[5].split(",")
    return [*rows[:5], ",".join([*cells[:column], text, *cells[column + 1 :]]), *rows[6:]]


# Bags, ROS 1 and ROS 2.

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.LATEST)
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"


def build(store, kind, stamp_ns, xyt, *, child="base_link", quaternion=None):
    """Make one message of a store's own types."""
    make = lambda name, *parts: store.types[f"geometry_msgs/msg/{name}"](*parts)
    sec, nanosec = divmod(int(stamp_ns), 10**9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec, nanosec)
    head = store.types["std_msgs/msg/Header"]
    header = head(0, stamp, "odom") if store is ROS1 else head(stamp, "odom")
    x, y, theta = (float(v) for v in xyt)
    turn = make("Quaternion", *(quaternion or (0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2))))
    if kind == TRANSFORM:
        return make(
            "TransformStamped", header, child, make("Transform", make("Vector3", x, y, 0.0), turn)
        )
    pose = make("Pose", make("Point", x, y, 0.0), turn)
    if kind == POSE:
        return make("PoseStamped", header, pose)
    still = make("Twist", make("Vector3", 0.0, 0.0, 0.0), make("Vector3", 0.0, 0.0, 0.0))
    return store.types[ODOMETRY](
        header,
        child,
        make("PoseWithCovariance", pose, np.zeros(36)),
        make("TwistWithCovariance", still, np.zeros(36)),
    )


def messages(store, kind, **options):
    return [build(store, kind, t, xyt, **options) for t, xyt in zip(STAMPS_NS, DRIVE, strict=True)]


def write_bag(path, store, topics, *, storage=StoragePlugin.SQLITE3):
    """Write topics (name -> type, messages) as a bag of the store's generation."""
    if store is ROS1:
        writer, pack = Writer1(path), store.serialize_ros1
    else:
        writer, pack = Writer2(path, version=9, storage_plugin=storage), store.serialize_cdr
    with writer:
        for name, (kind, listed) in topics.items():
            connection = writer.add_connection(name, kind, typestore=store)
            for at, own in enumerate(listed):
                writer.write(connection, START_NS + at, bytes(pack(own, kind)))
    return path


@pytest.mark.parametrize("kind", [ODOMETRY, POSE, TRANSFORM])
@pytest.mark.parametrize("version", ["ros1", "sqlite3", "mcap"])
def test_bags_of_both_versions_give_the_drive(tmp_path, kind, version):
    store = ROS1 if version == "ros1" else ROS2
    storage = StoragePlugin.MCAP if version == "mcap" else StoragePlugin.SQLITE3
    topics = {"/odom": (kind, messages(store, kind))}
    path = write_bag(tmp_path / "drive.bag", store, topics, storage=storage)
    if version != "ros1":
        path = path.rename(tmp_path / "drive")
    check(read_odometry(path, "bag"))
    assert kind_of(path) == "bag"
    inner = (
        tmp_path
        if version == "ros1"
        else next(path.glob("*.db3" if version[0] == "s" else "*.mcap"))
    )
    check(read_odometry(inner, "bag"))


def test_a_bag_with_several_topics_asks_which(tmp_path):
    topics = {
        "/wheel": (ODOMETRY, messages(ROS2, ODOMETRY)),
        "/icp": (POSE, messages(ROS2, POSE)[::2]),
        "/empty": (POSE, []),
        "/chatter": ("std_msgs/msg/String", [ROS2.types["std_msgs/msg/String"]("hello")]),
    }
    path = write_bag(tmp_path / "drive", ROS2, topics)
    with pytest.raises(InputError) as caught:
        read_odometry(path, "bag")
    message(caught, path, f"2 topics with poses; name one of /icp ({POSE}), /wheel ({ODOMETRY})")
    check(read_odometry(path, "bag", topic="/wheel"))
    assert len(read_odometry(path, "bag", topic="/icp").t_s) == N // 2
    for wrong in ("/chatter", "/empty", "/absent"):
        with pytest.raises(InputError) as caught:
            read_odometry(path, "bag", topic=wrong)
        message(caught, path, f"no poses on the topic {wrong}; choose a topic of it: /icp")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda own: [*own[:5], own[6], own[5], *own[7:]],
            "1 row came late, first topic /odom, message 7",
        ),
        (
            lambda own: [*own[:5], own[4], *own[5:]],
            "1 row repeats a stamp, first topic /odom, message 6",
        ),
    ],
)
def test_late_and_repeated_messages_are_put_right_and_said(tmp_path, change, said):
    topics = {"/odom": (ODOMETRY, change(messages(ROS2, ODOMETRY)))}
    drive = read_drive(write_bag(tmp_path / "drive", ROS2, topics), "bag")
    check(drive.poses)
    assert [note for note in drive.notes if said in note] == list(drive.notes)
    assert len(drive.notes) == 1


def test_a_bag_without_poses_says_what_it_holds(tmp_path):
    text = "std_msgs/msg/String"
    path = write_bag(tmp_path / "drive", ROS2, {"/chatter": (text, [ROS2.types[text]("hello")])})
    with pytest.raises(InputError) as caught:
        read_odometry(path, "bag")
    message(caught, path, f"holds /chatter ({text}), and no topic with poses")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda own: own[:1], "/odom has 1 message(s)"),
        (lambda own: [*own[20:], *own[:20]], "time runs backwards by"),
        (lambda own: [*own[:5], sixth(child="camera"), *own[6:]], "message 6 is of the frames"),
        (lambda own: [*own[:5], sixth([np.nan, 0, 0]), *own[6:]], "message 6: a number is not"),
        (lambda own: [*own[:5], sixth(quaternion=(0.0,) * 4), *own[6:]], "message 6: the quater"),
        (lambda own: [build(ROS2, ODOMETRY, 0, xyt) for xyt in DRIVE], "no stamps in its headers"),
    ],
)
def test_a_faulty_message_is_named(tmp_path, change, said):
    topics = {"/odom": (ODOMETRY, change(messages(ROS2, ODOMETRY)))}
    path = write_bag(tmp_path / "drive", ROS2, topics)
    with pytest.raises(InputError) as caught:
        read_odometry(path, "bag")
    message(caught, path, said)


def sixth(xyt=DRIVE[5], **options):
    return build(ROS2, ODOMETRY, STAMPS_NS[5], xyt, **options)


@pytest.mark.parametrize("version", ["ros1", "ros2"])
def test_a_damaged_bag_is_one_line(tmp_path, version):
    store = ROS1 if version == "ros1" else ROS2
    topics = {"/odom": (POSE, messages(store, POSE))}
    path = write_bag(tmp_path / "drive.bag", store, topics)
    if version == "ros2":
        path = path.rename(tmp_path / "drive")
    part = path if version == "ros1" else next(path.glob("*.db3"))
    part.write_bytes(part.read_bytes()[:2000])
    with pytest.raises(InputError) as caught:
        read_odometry(path, "bag")
    message(caught, path, "is not a readable bag")
    with pytest.raises(InputError, match="no such file"):
        read_odometry(tmp_path / "absent.bag", "bag")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="is not a readable bag"):
        read_odometry(tmp_path / "folder", "bag")


def test_without_rosbags_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'taojax\[ros\]'"):
        read_odometry(tmp_path, "bag")


# From a drive to the motion between frames.


def test_odometry_of_another_rate_gives_the_motion_between_frames():
    frames_s = T_S[0] + np.array([0.0, 1.0, 2.5, 4.0])
    got, note = odometry_at(Trajectory(T_S, DRIVE), frames_s, 0.2)
    np.testing.assert_allclose(got, motions(DRIVE[[0, 10, 25, 40]]), atol=1e-6)
    assert note is None
    got, _ = odometry_at(Trajectory(T_S, DRIVE), T_S[0] + np.array([0.05, 0.95]), 0.2)
    halfway = (DRIVE[[0, 9]] + DRIVE[[1, 10]]) / 2
    np.testing.assert_allclose(got, motions(halfway), atol=1e-5)


def test_the_origin_of_the_drive_does_not_matter():
    c, s = np.cos(2.0), np.sin(2.0)
    moved = DRIVE @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [4e5, 4e6, 2.0]
    got, _ = odometry_at(Trajectory(T_S, moved), T_S, 0.2)
    np.testing.assert_allclose(got, STEPS, atol=1e-8)


def test_frames_outside_the_odometry_wait_and_are_told():
    frames_s = np.r_[T_S, T_S[-1] + [1.0, 2.0]]
    got, note = odometry_at(Trajectory(T_S, DRIVE), frames_s, 0.2)
    np.testing.assert_allclose(got[:N], STEPS, atol=1e-6)
    np.testing.assert_array_equal(got[N:], 0.0)
    assert note is not None
    assert note.startswith(f"odometry: 2 of {N + 2} frames")


@pytest.mark.parametrize(
    ("frames_s", "said"),
    [
        (T_S + 1e6, "covers 0% of the 60 frames"),
        (T_S + 1e6, "frames run from 1501000000.000 to 1501000005.900 s"),
        (T_S + 1e6, "odometry from 1500000000.000 to 1500000005.900 s; give both the same clock"),
        (T_S * 1e3, "the stamps of the frames look 1e3 times too large"),
        (T_S * 1e6, "the stamps of the frames look 1e6 times too large"),
        (T_S * 1e-9, "the stamps of the odometry look 1e9 times too large"),
        (T_S - T_S[0], "give both the same clock"),
        (T_S + 4.0, "covers 35%"),
        (T_S + 4.0, "use denser odometry, a wider gate"),
    ],
)
def test_odometry_of_another_drive_or_clock_is_refused(frames_s, said):
    with pytest.raises(InputError) as caught:
        odometry_at(Trajectory(T_S, DRIVE), frames_s, 0.15)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_simulated_odometry_says_so_with_its_noise():
    got, note = simulated(DRIVE, 3)
    again, _ = simulated(DRIVE, 3)
    other_seed, _ = simulated(DRIVE, 4)
    np.testing.assert_array_equal(got, again)
    assert not np.array_equal(got, other_seed)
    np.testing.assert_allclose(got, STEPS, atol=0.2)
    np.testing.assert_array_equal(got[0], 0.0)
    assert note.startswith("simulated odometry: ")
    knobs = WorldConfig()
    for figure in (knobs.odometry_m, knobs.odometry_rad, knobs.odometry_yaw_rad_per_m):
        assert f"{figure:g}" in note
    assert "1.5%" in note
    assert "seed 3" in note
    with pytest.raises(InputError, match="seed -1"):
        simulated(DRIVE, -1)
