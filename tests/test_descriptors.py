"""Descriptors that users already have: every format lands on the right frame, no whole file lands
in memory, and what is wrong is one line."""

import gzip
import pickle
import subprocess
import sys

import h5py
import numpy as np
import pytest

from taojax.datasets.descriptors import read_views
from taojax.datasets.folder import Descriptors, Session, write_folder
from taojax.datasets.lists import Names
from taojax.datasets.trajectory import Trajectory
from taojax.errors import InputError
from taojax.runtime.observations import load_observations

N_MAP, N_QUERY, DIM = 9, 7, 5
KEPT = np.array([0, 2, 3, 7, 8]), np.array([1, 2, 5, 6])
WHOLE = np.arange(N_MAP), np.arange(N_QUERY)


def session(n, name="{:04d}.png"):
    xyt = np.c_[np.arange(n) * 2.0, np.zeros((n, 2))]
    return Session(tuple(name.format(row) for row in range(n)), Trajectory(np.arange(n) * 1.0, xyt))


SESSIONS = session(N_MAP), session(N_QUERY)


def codes(n, seed=0, dtype=np.float32):
    return np.random.default_rng(seed).normal(size=(n, DIM)).astype(dtype)


def save(path, array):
    np.save(path, array)
    return path


def save_h5(path, names, rows):
    with h5py.File(path, "a") as file:
        for name, row in zip(names, rows, strict=True):
            group = file.create_group(name)
            group["global_descriptor"] = row
            group["image_size"] = np.array([640, 512])
    return path


def refused(words, map_path, query_path=None, sessions=SESSIONS, kept=WHOLE):
    with pytest.raises(InputError) as caught:
        read_views(map_path, query_path, sessions, kept)
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in (map_path.name, *words) if word not in message] == []


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_rows_of_npy_are_frames_and_stay_on_disk(tmp_path, dtype):
    of_map, of_query = codes(N_MAP, 0, dtype), codes(N_QUERY, 1, dtype)
    paths = save(tmp_path / "m.npy", of_map), save(tmp_path / "q.npy", of_query)
    got = read_views(*paths, SESSIONS, KEPT)
    np.testing.assert_array_equal(got.map_rows, of_map[KEPT[0]])
    np.testing.assert_array_equal(got.query_rows, of_query[KEPT[1]])
    assert isinstance(got.map_rows, np.memmap)
    assert got.map_rows.dtype == dtype


def test_an_npy_with_one_row_per_kept_frame_is_taken_as_it_is(tmp_path):
    of_map, of_query = codes(len(KEPT[0])), codes(len(KEPT[1]), 1)
    paths = save(tmp_path / "m.npy", of_map), save(tmp_path / "q.npy", of_query)
    got = read_views(*paths, SESSIONS, KEPT)
    np.testing.assert_array_equal(got.map_rows, of_map)
    np.testing.assert_array_equal(got.query_rows, of_query)


def test_evenly_kept_rows_are_a_view_of_the_file(tmp_path):
    path = save(tmp_path / "m.npy", codes(N_MAP))
    got = read_views(path, path, (SESSIONS[0],) * 2, (np.arange(1, 9, 3), WHOLE[0]))
    assert got.map_rows.base is not None
    assert got.map_rows.filename == got.query_rows.filename == path


def test_rows_of_names_that_hold_positions_go_by_name(tmp_path):
    frames = ("@9@1@.jpg", "@8@5@.jpg", "@8@9@.jpg", "@7@7@.jpg")
    driven = Session(frames, session(4).poses)
    of_map = codes(4)
    path = save(tmp_path / "m.npy", of_map)
    got = read_views(path, path, (driven, driven), (np.arange(4), np.array([0, 1, 3])))
    np.testing.assert_array_equal(got.map_rows, of_map[[3, 1, 2, 0]])
    np.testing.assert_array_equal(got.query_rows, of_map[[3, 1, 0]])


def test_rows_that_may_go_by_name_or_by_time_are_refused(tmp_path):
    odd = session(12, "{}.png")
    path = save(tmp_path / "m.npy", codes(12))
    rows = np.arange(12)
    refused(["9.png", "10.png", "names"], path, path, (odd, odd), (rows, rows))
    numbered = session(12, "{}")
    assert isinstance(read_views(path, path, (numbered,) * 2, (rows, rows)), Descriptors)


@pytest.mark.parametrize("text", ["U", "S"])
@pytest.mark.parametrize("compressed", [False, True])
def test_rows_of_an_archive_with_paths_go_by_name(tmp_path, text, compressed):
    order = np.random.default_rng(3).permutation(N_MAP)
    rows = codes(N_MAP)
    paths = np.array([f"/mnt/day/{SESSIONS[0].frames[at]}" for at in order]).astype(text)
    saver = np.savez_compressed if compressed else np.savez
    saver(tmp_path / "m.npz", descs=rows[order], paths=paths)
    query = save(tmp_path / "q.npy", codes(N_QUERY))
    got = read_views(tmp_path / "m.npz", query, SESSIONS, KEPT)
    np.testing.assert_array_equal(got.map_rows, rows[KEPT[0]])


def test_an_archive_without_paths_is_read_as_npy(tmp_path):
    np.savez(tmp_path / "m.npz", descs=codes(N_MAP))
    got = read_views(tmp_path / "m.npz", tmp_path / "m.npz", (SESSIONS[0],) * 2, (WHOLE[0],) * 2)
    np.testing.assert_array_equal(got.query_rows, codes(N_MAP))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("above", ["", "day/cam0/"])
def test_groups_of_an_hloc_file_are_found_by_name(tmp_path, dtype, above):
    of_map, of_query = codes(N_MAP, 0, dtype), codes(N_QUERY, 1, dtype)
    groups = [[above + name for name in one.frames] for one in SESSIONS]
    paths = tmp_path / "m.h5", tmp_path / "q.h5"
    save_h5(paths[0], groups[0], of_map)
    save_h5(paths[1], groups[1], of_query)
    got = read_views(*paths, SESSIONS, KEPT)
    np.testing.assert_array_equal(got.map_rows, of_map[KEPT[0]])
    np.testing.assert_array_equal(got.query_rows, of_query[KEPT[1]])
    assert got.map_rows.dtype == dtype


@pytest.mark.parametrize("named_twice", [True, False])
def test_one_hloc_file_may_hold_both_sessions(tmp_path, named_twice):
    path = tmp_path / "both.h5"
    both = session(N_MAP, "day/{:04d}.png"), session(N_QUERY, "night/{:04d}.png")
    for seed, one in enumerate(both):
        save_h5(path, one.frames, codes(len(one.frames), seed))
    got = read_views(path, path if named_twice else None, both, KEPT)
    np.testing.assert_array_equal(got.query_rows, codes(N_QUERY, 1)[KEPT[1]])
    refused(["0000.png", "day/0000.png", "night/0000.png", "two files"], path, path, SESSIONS)


def test_a_frame_without_group_is_named(tmp_path):
    path = save_h5(tmp_path / "m.h5", SESSIONS[0].frames[:-1], codes(N_MAP - 1))
    refused(["0008.png", "extract"], path, path)
    got = read_views(path, path, (SESSIONS[0],) * 2, (np.arange(4), np.arange(3)))
    assert got.map_rows.shape == (4, DIM)


def bad_groups(path, kind):
    save_h5(path, SESSIONS[0].frames[1:], codes(N_MAP - 1))
    with h5py.File(path, "a") as file:
        group = file.create_group("0000.png")
        if kind == "lacks global_descriptor":
            group["local"] = codes(1)
        else:
            group["global_descriptor"] = {
                "shape (2, 5)": codes(2),
                "dtype int32": np.ones(DIM, np.int32),
                "has 4 numbers": codes(1)[0][:4],
                "not finite": np.full(DIM, np.nan, np.float32),
                "all zero": np.zeros(DIM, np.float32),
            }[kind]
    return path


@pytest.mark.parametrize(
    "kind",
    ["lacks global_descriptor", "shape (2, 5)", "dtype int32", "not finite", "all zero"],
)  # fmt: skip
def test_a_bad_group_is_named(tmp_path, kind):
    path = bad_groups(tmp_path / "m.h5", kind)
    refused([kind, "0000.png"], path, path)


def test_groups_of_two_networks_are_refused(tmp_path):
    path = bad_groups(tmp_path / "m.h5", "has 4 numbers")
    refused(["has 5 numbers", "has 4", "one network"], path, path)


def test_a_damaged_hloc_file_is_one_line(tmp_path):
    path = save_h5(tmp_path / "m.h5", SESSIONS[0].frames, codes(N_MAP))
    path.write_bytes(path.read_bytes()[:700])
    refused(["HDF5"], path, path)
    (tmp_path / "text.h5").write_text("no HDF5 at all")
    refused(["HDF5"], tmp_path / "text.h5", path)


def edited(change):
    def make(path):
        rows = codes(N_MAP)
        np.save(path, change(rows))

    return make


def with_value(value):
    def change(rows):
        rows = rows.astype(np.float64)
        rows[4] = value
        return rows

    return edited(change)


BAD_ARRAYS = {
    "a row too few": (edited(lambda a: a[:-1]), ["8 rows", "9 frames", "names"]),
    "NaN": (with_value(np.nan), ["row 4", "0004.png", "not finite"]),
    "more than float32 holds": (with_value(1e300), ["row 4", "not finite"]),
    "a zero row": (with_value(0.0), ["row 4", "all zero"]),
    "complex": (edited(lambda a: a.astype(np.complex64)), ["complex64"]),
    "one axis": (edited(lambda a: a[:, 0]), ["(9,)"]),
    "objects": (edited(lambda a: np.array([{}, 1], dtype=object)), ["plain numpy array"]),
    "a pickle": (lambda p: p.write_bytes(pickle.dumps([1])), ["plain numpy array"]),
    "gzip": (lambda p: p.write_bytes(gzip.compress(b"x" * 99)), ["gzip", "unpack"]),
    "empty": (lambda p: p.write_bytes(b""), ["empty"]),
    "missing": (lambda p: None, ["no such file"]),
    "cut short": (
        lambda p: (np.save(p, codes(N_MAP)), p.write_bytes(p.read_bytes()[:150])),
        ["plain numpy array"],
    ),
}


@pytest.mark.parametrize("kind", BAD_ARRAYS)
def test_a_bad_npy_is_one_line_with_row_and_fix(tmp_path, kind):
    make, words = BAD_ARRAYS[kind]
    path = tmp_path / "m.npy"
    make(path)
    refused(words, path, path)


BAD_ARCHIVES = {
    "no descs": ({"a": codes(N_MAP), "b": codes(N_MAP)}, ["lacks the array descs", "a, b"]),
    "too few paths": ({"descs": codes(N_MAP), "paths": np.array(["a"])}, ["9 descs but 1 paths"]),
    "a path missing": (
        {"descs": codes(N_MAP), "paths": np.array(list("abcdefghi"))},
        ["no path", "0000.png"],
    ),
    "numbers for paths": ({"descs": codes(N_MAP), "paths": np.arange(9)}, ["paths", "int64"]),
    "objects": ({"descs": np.array([{}], dtype=object)}, ["plain npz"]),
}


@pytest.mark.parametrize("kind", BAD_ARCHIVES)
def test_a_bad_archive_is_one_line(tmp_path, kind):
    arrays, words = BAD_ARCHIVES[kind]
    np.savez(tmp_path / "m.npz", **arrays)
    refused(words, tmp_path / "m.npz", tmp_path / "m.npz")


def test_a_cut_archive_and_a_bomb_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "m.npz"
    np.savez(path, descs=codes(N_MAP))
    monkeypatch.setattr("taojax.datasets.arrays.MAX_BYTES", 100)
    refused(["8 GiB"], path, path)
    path.write_bytes(path.read_bytes()[:99])
    refused(["npz archive"], path, path)


def test_sides_of_two_networks_and_unknown_endings_are_refused(tmp_path):
    wide = save(tmp_path / "q.npy", np.ones((N_QUERY, 3), np.float32))
    with pytest.raises(InputError, match=r"q\.npy: dimension 3.*m\.npy has 5"):
        read_views(save(tmp_path / "m.npy", codes(N_MAP)), wide, SESSIONS, WHOLE)
    (tmp_path / "m.pkl").write_text("x")
    refused([".pkl", ".npy"], tmp_path / "m.pkl", wide)
    refused([".pkl", ".csv"], tmp_path / "m.pkl")


MEMORY = """
import resource, sys
from pathlib import Path
import numpy as np
from taojax.datasets.descriptors import read_views
from taojax.datasets.folder import Session, write_folder
from taojax.datasets.trajectory import Trajectory
n, dim = 6000, 8448
path = Path(sys.argv[1])
rows = np.lib.format.open_memmap(path, "w+", np.float32, (n, dim))
rows[:, 0] = 1.0  # the other pages stay holes in the file
rows.flush()
del rows
drive = Session(tuple(map(str, range(n))), Trajectory(np.arange(n) * 1.0, np.ones((n, 3))))
kept = np.sort(np.random.default_rng(0).permutation(n)[:1500])
used = int(next(l for l in open("/proc/self/status") if l.startswith("VmData")).split()[1])
limit = used * 1024 + (40 << 20)
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
few = np.arange(3)
assert read_views(path, path, (drive, drive), (np.arange(n), few)).map_rows.shape == (n, dim)
views, out = read_views(path, path, (drive, drive), (kept, few)), path.with_name("out")
poses = Trajectory(drive.poses.t_s[kept], drive.poses.xyt[kept])
write_folder(out, poses, (few * 1.0, np.zeros((3, 3))), views, truth=None, notes=())
assert np.load(out / "map/descriptors.npy", mmap_mode="r").shape == (len(kept), dim)
try:
    np.ones((len(kept), dim), np.float32)
except MemoryError:
    print("bounded")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the limit of memory is Linux's")
def test_choosing_rows_of_200_megabytes_takes_less_than_40(tmp_path):
    words = [sys.executable, "-c", MEMORY, str(tmp_path / "big.npy")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["bounded"], done.stderr


def test_what_is_read_goes_through_the_writer_to_the_robot(tmp_path):
    save_h5(tmp_path / "m.h5", SESSIONS[0].frames, codes(N_MAP, 0, np.float16))
    query = save(tmp_path / "q.npy", codes(N_QUERY, 1, np.float64))
    views = read_views(tmp_path / "m.h5", query, SESSIONS, KEPT)
    mapped = Trajectory(*(part[KEPT[0]] for part in SESSIONS[0].poses))
    steps = np.zeros((len(KEPT[1]), 3))
    out = tmp_path / "data"
    write_folder(out, mapped, (KEPT[1] * 1.0, steps), views, truth=None, notes=())
    of_map, of_query = load_observations(out).descriptors
    np.testing.assert_array_equal(of_map, codes(N_MAP, 0, np.float16)[KEPT[0]])
    np.testing.assert_array_equal(of_query, codes(N_QUERY, 1)[KEPT[1]])


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ("day/1.png", [0]),
        ("./day/1.png", [0]),
        ("/mnt/x/day/1.png", [0]),
        ("night\\1.png", [1]),
        ("1.png", [0, 1]),
        ("other/1.png", [0, 1]),
        ("other/2.png", [2]),
        ("3.png", []),
        ("", []),
    ],
)
def test_names_are_found_whole_or_by_their_unique_end(wanted, found):
    assert Names(["day/1.png", "night/1.png", "day/2.png"]).find(wanted) == found
