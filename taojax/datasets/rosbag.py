"""Poses out of ROS 1 and ROS 2 bags, through the extra `ros`."""

from pathlib import Path
from typing import Any

import numpy as np

from taojax.datasets.clocks import in_order
from taojax.datasets.reading import Drive, Plane
from taojax.datasets.trajectories import LARGEST, flat_poses, rotations
from taojax.datasets.trajectory import Trajectory
from taojax.errors import InputError, MissingExtraError
from taojax.files.specs import fail

__all__ = ["read_bag"]

TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/TransformStamped",
)
"""Messages that hold one stamped pose."""

# Stamp [ns], frames, x, y, z [m], qx, qy, qz, qw.
_Row = tuple[int, tuple[str, str], list[float]]


def read_bag(path: Path, *, topic: str | None = None, plane: Plane = "xy") -> Drive:
    """Read the poses of one topic.

    Args:
        path: a ROS 1 .bag file or a folder of them, a ROS 2 folder, or one .mcap or .db3 file.
        topic: needed where several topics hold poses.
        plane: how they are laid flat (see `trajectories`); ROS frames are z-up: `xy`.

    Returns:
        At least two poses in the order of their stamps, which are those of the messages' headers,
        not of the recorder; late and repeated messages are counted.

    Raises:
        InputError: no bag, no such topic or several, frames that change, a clock that runs back
            for long, one stamp with two poses, a pose that is not finite or no pose; it names the
            message, counted from 1.
        MissingExtraError: rosbags is not installed.
    """
    rows, topic = _read_rows(path, topic)
    if len(rows) < 2:
        raise fail(path, f"topic {topic} has {len(rows)} message(s)", "at least 2 are needed")
    where = lambda index: f"topic {topic}, message {index + 1}"
    frames = [row[1] for row in rows]
    if other := [index for index, own in enumerate(frames) if own != frames[0]]:
        what = f"{where(other[0])} is of the frames {frames[other[0]]}, the first of {frames[0]}"
        raise fail(path, what, "put each pair of frames on a topic of its own")
    stamps = np.array([row[0] for row in rows], dtype=np.int64)
    if stamps[0] == 0 and stamps[-1] == 0:
        raise fail(path, f"topic {topic} has no stamps in its headers", "stamp the messages")
    values = np.array([row[2] for row in rows], dtype=float)
    if (odd := np.flatnonzero(~(np.abs(values) <= LARGEST).all(axis=1))).size:
        what = f"{where(int(odd[0]))}: a number is not finite or beyond {LARGEST:g}"
        raise fail(path, what, "cut the message out of the bag")
    rotation = rotations(path, values[:, 3:], where)
    xyt = flat_poses(path, values[:, :3], rotation, plane, where)
    order = in_order(path, stamps / 1e9, xyt, where)
    poses = Trajectory(stamps[order.rows] / 1e9, xyt[order.rows])
    return Drive(poses, order.notes, True, order.rows, len(rows))


def _read_rows(path: Path, topic: str | None) -> tuple[list[_Row], str]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingExtraError(
            "bags need rosbags; run: python -m pip install 'taojax[ros]'"
        ) from error
    if not path.exists():
        raise fail(path, "no such file", "add it or point at another bag")
    if not path.is_dir() and not path.is_file():
        # A pipe or a device may never end.
        raise fail(path, "is a pipe or device", "point at a bag")
    # ROS 1 splits long recordings into files; a ROS 2 folder has its own table of contents.
    parts = sorted(path.glob("*.bag")) if path.is_dir() else []
    store = get_typestore(Stores.LATEST)
    try:
        with AnyReader(parts or [path], default_typestore=store) as bag:
            held = {c.topic: c.msgtype for c in bag.connections if c.msgcount}
            chosen = _choose(path, held, topic)
            own = [c for c in bag.connections if c.topic == chosen]
            rows = [
                _row(bag.deserialize(raw, connection.msgtype))
                for connection, _, raw in bag.messages(connections=own)
            ]
    except InputError:
        raise
    # Damaged bytes surface as anything: struct, sqlite3, YAML, assertion and decoding errors.
    except Exception as error:
        what = f"is not a readable bag ({(str(error).splitlines() or [type(error).__name__])[0]})"
        raise fail(path, what[:200], "check it with rosbag or ros2 bag info") from error
    return rows, chosen


def _choose(path: Path, held: dict[str, str], topic: str | None) -> str:
    """Return the topic asked for, or the only one with poses."""
    fits = sorted(name for name, kind in held.items() if kind in TYPES)
    listed = ", ".join(f"{name} ({held[name]})" for name in fits or sorted(held)) or "nothing"
    if topic is not None and topic not in fits:
        what = f"has no poses on the topic {topic}"
        raise fail(path, what, f"choose a topic of it: {listed}")
    if not fits:
        what = f"holds {listed}, and no topic with poses"
        raise fail(path, what, f"record one of {', '.join(TYPES)}")
    if topic is None and len(fits) > 1:
        raise fail(path, f"has {len(fits)} topics with poses", f"name one of {listed}")
    return topic or fits[0]


def _row(message: Any) -> _Row:
    """Take a pose out of any of the three messages."""
    if hasattr(message, "transform"):
        at, turn = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        at, turn = pose.position, pose.orientation
    stamp, frame = message.header.stamp, message.header.frame_id
    values = [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
    frames = (frame, getattr(message, "child_frame_id", ""))
    return stamp.sec * 10**9 + stamp.nanosec, frames, values
