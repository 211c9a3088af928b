"""Hostile files: every reader ends well or with one line; what was repaired stays repaired."""

import io
import os
import pickle
import zipfile

import numpy as np
import pytest

from benchmarks import reliability_fuzz as fuzz
from benchmarks.reliability_arrays import Canary, changed
from benchmarks.reliability_recordings import recordings
from benchmarks.reliability_targets import own_files, tables
from taojax.datasets.odometry import read_odometry
from taojax.errors import InputError
from taojax.files.records import digest_file
from taojax.files.specs import read_bytes, read_npy, read_npz
from taojax.files.tables import read_table

READERS = [*tables(), *own_files(), *recordings()]


@pytest.mark.parametrize("target", READERS, ids=lambda target: target.name)
def test_hostile_files_are_read_or_refused_in_one_line(target, tmp_path, monkeypatch):
    place = tmp_path / "place"
    fuzz.prepare(target, place)
    monkeypatch.chdir(place / "cwd")
    cases = [fuzz.run_case(target, number, place) for number in range(6)]
    assert [case for case in cases if case.outcome not in fuzz.GOOD] == []


def test_what_a_case_breaks_is_put_back(tmp_path):
    target = next(t for t in READERS if t.name == "data folder")
    fuzz.prepare(target, tmp_path)
    read = lambda: {p: p.read_bytes() for p in (tmp_path / "sound").rglob("*") if p.is_file()}
    before = read()
    for number in range(30):
        fuzz.run_case(target, number, tmp_path)
    assert read() == before


def test_a_pickle_that_is_loaded_would_be_noticed(tmp_path):
    pickle.loads(pickle.dumps(Canary(tmp_path / "canary"))).close()  # noqa: S301
    assert (tmp_path / "canary").exists()


def test_the_same_number_is_the_same_attack(tmp_path):
    raw = b"t_s,x_m\n1,2\n3,4\n"
    path = tmp_path / "a.csv"
    seeds = [np.random.default_rng(3), np.random.default_rng(3)]
    assert len({changed(path, raw, rng, tmp_path / "canary") for rng in seeds}) == 1


# Found by the long form.


def npy(header):
    """Return an array file with a header of one's own."""
    text = header.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


SHAPES = "{'descr': '<f4', 'fortran_order': False, 'shape': (%s), }"


@pytest.mark.parametrize(
    "header", ["{'descr': '<f4', (", SHAPES % "9999999999999, 4", SHAPES % f"{2**62}, {2**62}"]
)
def test_an_array_whose_header_lies_is_one_line(tmp_path, header):
    (tmp_path / "a.npy").write_bytes(npy(header))
    with pytest.raises(InputError, match=r"a\.npy: is not a plain numpy array"):
        read_npy(tmp_path / "a.npy", "descriptors")
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        for name in ("index", "similarity"):
            archive.writestr(f"{name}.npy", npy(header))
    (tmp_path / "a.npz").write_bytes(held.getvalue())
    with pytest.raises(InputError, match=r"a\.npz: is not a plain npz archive"):
        read_npz(tmp_path / "a.npz", "retrievals")


def test_an_archive_member_that_is_no_array_is_one_line(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("index.npy", b"text")
        archive.writestr("similarity.npy", b"text")
    with pytest.raises(InputError, match="index is not an array"):
        read_npz(tmp_path / "a.npz", "retrievals")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_never_ends_is_not_read(tmp_path, kind):
    path = tmp_path / "a.bag"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    for read in (read_bytes, digest_file):
        with pytest.raises(InputError, match="cannot be read"):
            read(path)
    if kind != "folder":
        with pytest.raises(InputError, match="pipe or device"):
            read_odometry(path, "bag")


@pytest.mark.parametrize("stamp", ["9223372036854775808", "-9223372036854775809", "9" * 4000])
def test_a_stamp_beyond_64_bits_is_one_line(tmp_path, monkeypatch, stamp):
    spec = {"columns": [{"name": "t_ns", "type": "stamp"}]}
    monkeypatch.setattr("taojax.files.tables.load_spec", lambda name: spec)
    (tmp_path / "a.csv").write_text(f"t_ns\n1\n{stamp}\n")
    with pytest.raises(InputError, match=r"row 3, column t_ns: .* is outside"):
        read_table(tmp_path / "a.csv", "any")


def test_stamps_at_both_ends_of_64_bits_are_in_order(tmp_path, monkeypatch):
    spec = {"columns": [{"name": "t_ns", "type": "stamp", "increasing": True}]}
    monkeypatch.setattr("taojax.files.tables.load_spec", lambda name: spec)
    (tmp_path / "a.csv").write_text(f"t_ns\n{-(2**63)}\n{2**63 - 1}\n")
    assert read_table(tmp_path / "a.csv", "any")["t_ns"].tolist() == [-(2**63), 2**63 - 1]
