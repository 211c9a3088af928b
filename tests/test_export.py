"""The exported step: the bits of `taojax.step` in a process that cannot import taojax."""

import subprocess
import sys
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import write_folder
from jax import export

import taojax
from taojax.cli import main
from taojax.config import from_toml
from taojax.files.records import digest_file, read_manifest, signal_names
from taojax.files.specs import load_spec
from taojax.runtime.export import columns

T = 60
FLAGS = ["--window", "6", "--branches", "5", "--no-progress"]
SETTINGS = "[stream]\nwindow = 6\n"

ALONE = """
import sys

class Wall:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("taojax", "equinox", "optimistix", "jaxtyping"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Wall())
"""

REPLAY = """
import numpy as np
from load_step import load

frames = np.load("frames.npz")
step, state = load()
records = []
for frame in zip(frames["odometry"], frames["index"], frames["similarity"], strict=True):
    state, record = step(state, *frame)
    records.append(record)
said = {name: np.stack([record[name] for record in records]) for name in records[0]}
np.savez("said.npz", *state, **said)
"""

CHECK = """
import runpy
import numpy as np
from load_step import load

step, state = load()
still, similarity = np.zeros(3), np.linspace(0.9, 0.1, 9)
for n in (2, 9):
    _, record = step(state, still, np.arange(n), similarity[:n])
    print(float(record["top1"]))
runpy.run_path("load_step.py", run_name="__main__")
"""


def alone(folder, code):
    """Run code in a fresh process in which this package cannot be imported."""
    words = [sys.executable, "-c", ALONE + code]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    rng = np.random.default_rng(zlib.crc32(b"export"))
    return write_folder(tmp_path_factory.mktemp("export") / "data", rng, n_query=T)


@pytest.fixture(scope="module")
def exported(data):
    """The joint step, for both platforms."""
    path, out = data.parent / "config.toml", data.parent / "step"
    path.write_text(SETTINGS)
    assert main(["export", str(data), "--out", str(out), "--config", str(path), *FLAGS]) == 0
    return out


def test_a_process_without_this_package_gives_the_bits_of_step(data, exported):
    with np.load(exported / "example.npz") as arrays:
        frames = [arrays[f"frame.{name}"].copy() for name in ("odometry", "index", "similarity")]
    frames[0][20] = np.nan
    frames[1][30:33] = -1
    np.savez(exported / "frames.npz", odometry=frames[0], index=frames[1], similarity=frames[2])
    alone(exported, REPLAY)

    config = from_toml(exported / "config.toml").stream
    poses = np.loadtxt(data / "map/poses.csv", delimiter=",", skiprows=1)[:, 1:]
    tables = taojax.map_tables(poses, config, np.load(data / "map/descriptors.npy"))
    state, records = taojax.init(config, tables), []
    for frame in zip(*map(jnp.asarray, frames), strict=True):
        state, record = taojax.step(config, tables, state, taojax.Frame(*frame))
        records.append(columns(record))
    with np.load(exported / "said.npz") as said:
        want = {f"arr_{i}": leaf for i, leaf in enumerate(jax.tree.leaves(state))}
        want |= {name: np.stack([row[name] for row in records]) for name in records[0]}
        assert set(said.files) == set(want)
        for name, array in want.items():
            assert said[name].dtype == array.dtype
            np.testing.assert_array_equal(said[name], array, err_msg=name)
    assert len(records) == T


def test_the_manifest_lists_what_either_artefact_takes_and_returns(exported):
    manifest = read_manifest(exported)
    keys = set(load_spec("export")["keys"])
    assert keys < set(manifest) <= keys | set(load_spec("manifest")["keys"])
    assert manifest["platforms"] == ["cpu", "cuda"]
    assert set(manifest["signals"]) == set(signal_names())
    assert manifest["statuses"] == list(taojax.STATUSES)
    names = [output["name"] for output in manifest["outputs"]]
    fields = ["status", "map_index", "pose", "has_pose"]
    assert names[-5:-1] == [f"record.{name}" for name in fields]
    assert manifest["outputs"][-1]["shape"] == [len(manifest["signals"])]
    assert all(name.startswith("state.") for name in names[:-5])
    frame = [i for i in manifest["inputs"] if i["name"].startswith("frame.")]
    assert [i["shape"] for i in frame] == [[3], [5], [5]]
    assert frame == manifest["inputs"][-3:]
    for platform in manifest["platforms"]:
        raw = (exported / f"step.{platform}.jaxexport").read_bytes()
        found = export.deserialize(bytearray(raw))
        assert found.platforms == (platform,)
        for listed, avals in (("inputs", found.in_avals), ("outputs", found.out_avals)):
            got = [(list(aval.shape), aval.dtype.name) for aval in avals]
            assert got == [(entry["shape"], entry["dtype"]) for entry in manifest[listed]]


def test_the_manifest_vouches_for_every_file(exported):
    hashes = read_manifest(exported)["sha256"]
    mine = ["config.toml", "load_step.py", "start.npz", "example.npz"]
    for name in (*mine, "step.cpu.jaxexport", "step.cuda.jaxexport"):
        assert hashes[name] == digest_file(exported / name)
    assert "inputs/map/poses.csv" in hashes


def test_the_loader_takes_lists_of_any_length_and_checks_itself(data, tmp_path, capsys):
    out = tmp_path / "rank"
    words = ["--association", "rank", "--platforms", "cpu", *FLAGS]
    assert main(["export", str(data), "--out", str(out), *words]) == 0
    assert "load_step.py" in capsys.readouterr().err
    assert not (out / "step.cuda.jaxexport").exists()
    *shorter_and_longer, said = alone(out, CHECK).splitlines()
    assert said.startswith(f"{T} frames")
    assert "equal bit for bit" in said
    np.testing.assert_allclose(np.array(shorter_and_longer, float), 0.1, rtol=1e-6)


def fails(capsys, code, *words):
    """Run a command that must fail with one line; return the line."""
    try:
        got = main(["export", *words])
    except SystemExit as stop:
        got = stop.code
    err = capsys.readouterr().err.strip()
    assert got == code, err
    assert "Traceback" not in err
    return err


def test_a_folder_in_use_and_bad_input_are_exit_3_and_leave_everything(data, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("keep")
    line = fails(capsys, 3, str(data), "--out", str(tmp_path), *FLAGS)
    assert "already holds files; choose a new --out" in line
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    line = fails(capsys, 3, str(tmp_path / "none"), "--out", str(tmp_path / "step"), *FLAGS)
    assert "no such data folder" in line
    assert len(line.splitlines()) == 1
    assert not (tmp_path / "step").exists()


def test_without_flatbuffers_the_pip_command_is_named(data, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    line = fails(capsys, 4, str(data), "--out", str(tmp_path / "step"), *FLAGS)
    assert line.endswith("python -m pip install 'taojax[export]'")
    assert len(line.splitlines()) == 1
    assert not (tmp_path / "step").exists()


@pytest.mark.parametrize("words", [("--platforms",), ("--platforms", "tpu")])
def test_unknown_platforms_are_exit_2(words, capsys):
    fails(capsys, 2, *words)


def test_help_shows_an_example_and_imports_neither_jax_nor_equinox():
    code = (
        "import sys\nfrom taojax.cli import main\n"
        "try:\n    main(['export', '--help'])\n"
        "except SystemExit as stop:\n    assert not stop.code\n"
        "print([m for m in sys.modules if m in ('jax', 'equinox', 'pandas', 'matplotlib')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Example: taojax export" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"
