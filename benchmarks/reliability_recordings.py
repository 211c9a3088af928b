"""What is attacked: readers of other people's recordings."""

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.io import savemat

from benchmarks.reliability_targets import (
    DIM,
    N_MAP,
    N_QUERY,
    K,
    Target,
    from_tests,
    write_data,
)
from taojax.datasets import public_sets


def _sessions(name: str, folder: Path, out: Path, **more: Any) -> list[np.ndarray]:
    read = {
        "sthereo": public_sets.read_sthereo,
        "mulran": public_sets.read_mulran,
        "complex-urban": public_sets.read_complex_urban,
        "robotcar": public_sets.read_robotcar,
        "vivid": public_sets.read_vivid,
        "kri": public_sets.read_kri,
    }[name]
    session = read(folder / "query", **more)
    return [session.poses.t_s, session.poses.xyt]


def _both(write: Callable[..., object], folder: Path, **more: Any) -> None:
    write(folder / "map", **more)
    write(folder / "query", **({"left_m": 0.4} if more.pop("moved", True) else {}), **more)


def _robotcar(folder: Path) -> None:
    _both(from_tests("foreign").robotcar, folder)
    shutil.copy(folder / "query/gps/ins.csv", folder / "query/gps/rtk.csv")


def write_kri(folder: Path) -> None:
    for side, n in (("map", 50), ("query", 40)):
        from_tests("foreign").kri(folder / side, n)


def _complex_urban(folder: Path) -> None:
    foreign = from_tests("foreign")
    _both(foreign.mulran, folder, frames="image/stereo_left", suffix=".png")
    foreign.wheels(folder / "query")


def _sthereo(folder: Path) -> None:
    foreign = from_tests("foreign")
    _both(foreign.sthereo, folder)
    foreign.sensors(folder / "query")


def _vivid(folder: Path) -> None:
    _both(from_tests("foreign").vivid, folder, listed=True)


def _struct(folder: Path) -> None:
    names = np.array([f"images-{at:05d}.png" for at in range(30)], object)
    xy = from_tests("conftest").loop(30)[:, :2].T
    fields = {"dbImageFns": names, "qImageFns": names[:20], "utmDb": xy, "utmQ": xy[:, :20]}
    savemat(folder / "oxford.mat", {"dbStruct": fields})


def _named(folder: Path) -> None:
    for side in ("database", "queries"):
        xy = from_tests("conftest").loop(30)[:, :2]
        names = [f"i/@{x:.2f}@{y:.2f}@10@S@@@{at:05d}@.jpg" for at, (x, y) in enumerate(xy)]
        (folder / f"{side}_images_paths.txt").write_text("\n".join(sorted(names)) + "\n")


def _plain(folder: Path, out: Path) -> list[np.ndarray]:
    from taojax.datasets.plain import read_plain

    return [
        array for session in read_plain(folder) if session is not None for array in session.poses
    ]


def _drive_files(folder: Path) -> None:
    n = 60
    pose = from_tests("conftest").loop(n, 60.0)
    t_s = 1.6e9 + np.arange(n)
    c, s, zero, half = np.cos(pose[:, 2]), np.sin(pose[:, 2]), np.zeros(n), pose[:, 2] / 2
    flat = [zero, zero, np.sin(half), np.cos(half)]
    write = functools.partial(np.savetxt, fmt="%.9f")
    write(folder / "drive.tum", np.column_stack([t_s, pose[:, :2], zero, *flat]))
    matrix = [c, zero, -s, -pose[:, 1], zero, zero + 1, zero, zero, s, zero, c, pose[:, 0]]
    write(folder / "drive.kitti", np.column_stack(matrix))
    write(folder / "times.txt", t_s)
    euroc = np.column_stack([pose[:, :2], zero, flat[3], *flat[:3]])
    rows = [
        f"{int(t)}000000000," + ",".join(f"{v:.9f}" for v in row)
        for t, row in zip(t_s, euroc, strict=True)
    ]
    (folder / "drive.euroc").write_text("\n".join(rows) + "\n")
    rows = [f"VERTEX_SE2 {at} {x:.6f} {y:.6f} {a:.6f}" for at, (x, y, a) in enumerate(pose)]
    (folder / "drive.g2o").write_text("\n".join(rows) + "\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    table = from_tests("conftest").table
    table(folder / "drive.csv", "t_s,x_m,y_m,theta_rad", np.column_stack([t_s, pose]))
    steps = from_tests("conftest").motions(pose)
    table(folder / "steps.csv", "t_s,dx_m,dy_m,dtheta_rad", np.column_stack([t_s, steps]))


def _read_drive(kind: str, folder: Path, out: Path) -> list[np.ndarray]:
    from taojax.datasets.odometry import odometry_at, read_odometry
    from taojax.datasets.reading import Reading

    name = {"steps": "steps.csv", "robotcar-vo": "query/vo/vo.csv", "wheels": "query"}.get(
        kind, f"drive.{kind}"
    )
    times = folder / "times.txt" if kind == "kitti" else None
    drive = read_odometry(folder / name, kind, Reading(times=times)).poses  # type: ignore[arg-type]
    motion, _ = odometry_at(drive, drive.t_s, 0.5)
    return [drive.t_s, drive.xyt, motion]


def _view_files(folder: Path) -> None:
    rng = np.random.default_rng(0)
    for side, n in (("map", N_MAP), ("query", N_QUERY)):
        names, rows = (
            [f"{at:06d}.png" for at in range(n)],
            rng.normal(size=(n, DIM)).astype(np.float32),
        )
        np.save(folder / f"{side}.npy", rows)
        np.savez(folder / f"{side}.npz", descs=rows, paths=np.array(names))
        with h5py.File(folder / f"{side}.h5", "w") as file:
            for name, row in zip(names, rows, strict=True):
                file[f"{name}/global_descriptor"] = row
    np.save(
        folder / "matrix.npy",
        np.linspace(-1, 1, N_QUERY * N_MAP).reshape(N_QUERY, N_MAP).astype(np.float32),
    )
    index = np.tile(np.arange(K), (N_QUERY, 1))
    np.savez(
        folder / "lists.npz",
        index=index,
        similarity=np.tile(np.linspace(0.9, 0.1, K), (N_QUERY, 1)),
    )
    pairs = [
        (f"{q:06d}.png", f"{k:06d}.png", f"{0.9 - 0.1 * k:.2f}")
        for q in range(N_QUERY)
        for k in range(K)
    ]
    (folder / "lists.csv").write_text(
        "query,map,similarity\n" + "".join(",".join(p) + "\n" for p in pairs)
    )
    (folder / "lists.txt").write_text("".join(" ".join(p) + "\n" for p in pairs))


def _read_views(names: tuple[str, ...], folder: Path, out: Path) -> list[np.ndarray]:
    from taojax.datasets.descriptors import read_views, view_notes
    from taojax.datasets.folder import Session
    from taojax.datasets.trajectory import Trajectory

    sessions = [
        Session(
            tuple(f"{at:06d}.png" for at in range(n)),
            Trajectory(np.arange(float(n)), np.zeros((n, 3))),
        )
        for n in (N_MAP, N_QUERY)
    ]
    paths = folder / names[0], folder / names[1] if len(names) == 2 else None
    kept = np.arange(0, N_MAP, 2), np.arange(3, N_QUERY)
    views = read_views(*paths, (sessions[0], sessions[1]), kept)
    view_notes(*paths)
    return [np.asarray(array) for array in vars(views).values()]


def _bag(folder: Path) -> None:
    bags = from_tests("test_odometry_sources")
    topics = {"/odom": (bags.POSE, bags.messages(bags.ROS1, bags.POSE)[:6])}
    bags.write_bag(folder / "drive.bag", bags.ROS1, topics)


def recordings() -> list[Target]:
    folders: list[tuple[str, Callable[[Path], None], tuple[str, ...]]] = [
        ("sthereo", _sthereo, ("query/pose/global_pose.csv",)),
        (
            "mulran",
            lambda folder: _both(from_tests("foreign").mulran, folder),
            ("query/global_pose.csv",),
        ),
        ("complex-urban", _complex_urban, ("query/global_pose.csv",)),
        ("robotcar", _robotcar, ("query/gps/ins.csv", "query/stereo.timestamps")),
        ("vivid", _vivid, ("query/gpslist.txt",)),
    ]
    kinds = ("tum", "kitti", "euroc", "g2o", "csv", "steps")
    views = (("map.npy", "query.npy"), ("map.npz", "query.npz"), ("map.h5", "query.h5"))
    one = (("matrix.npy",), ("lists.npz",), ("lists.csv",), ("lists.txt",))
    also = {"kitti": ("drive.kitti", "times.txt"), "steps": ("steps.csv",)}
    wheels = (
        "query/sensor_data/encoder.csv",
        "query/sensor_data/fog.csv",
        "query/calibration/EncoderParameter.txt",
    )
    return [
        *(Target(f"session {n}", b, f, functools.partial(_sessions, n)) for n, b, f in folders),
        *(
            Target(
                f"drive {k}",
                _drive_files,
                also.get(k, (f"drive.{k}",)),
                functools.partial(_read_drive, k),
            )
            for k in kinds
        ),
        Target(
            "drive robotcar-vo",
            _robotcar,
            ("query/vo/vo.csv",),
            functools.partial(_read_drive, "robotcar-vo"),
        ),
        Target("drive wheels", _complex_urban, wheels, functools.partial(_read_drive, "wheels")),
        Target("drive bag", _bag, ("drive.bag",), functools.partial(_read_drive, "bag")),
        *(
            Target(f"views {n[0]}", _view_files, n, functools.partial(_read_views, n))
            for n in (*views, *one)
        ),
        Target("folder of names", _named, ("database_images_paths.txt",), _plain),
        Target("folder dbStruct", _struct, ("oxford.mat",), _plain),
        Target("folder with poses", write_data, ("map/poses.csv", "truth/query_poses.csv"), _plain),
    ]
