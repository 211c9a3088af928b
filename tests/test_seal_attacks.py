"""Attempts to fool the judge, or to show the robot the truth: each fails, and is named.

Of accidents, that is, and clumsy cheats: who seals a changed run anew is not caught, for the seal
has no key.
"""

import io
import json
import os
import shutil

import numpy as np
import pytest
import test_wall
from conftest import write_folder

from taojax.baselines.sequence import sue
from taojax.cli import main
from taojax.config import Config, StreamConfig
from taojax.errors import InputError
from taojax.files import records
from taojax.runtime import rivals
from taojax.runtime.score import score

SMALL = Config(stream=StreamConfig(window=6, branches=5))


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A data folder, its sealed run, and the run of another drive."""
    home = tmp_path_factory.mktemp("home")
    for name, seed in (("data", 5), ("other_data", 6)):
        write_folder(home / name, np.random.default_rng(seed))
    score(home / "data", home / "run", SMALL)
    score(home / "other_data", home / "other", SMALL)
    return home


@pytest.fixture
def attacked(home, tmp_path):
    """A copy of the sealed run."""
    return shutil.copytree(home / "run", tmp_path / "run")


@pytest.fixture
def data(home, tmp_path):
    """A copy of the data folder."""
    return shutil.copytree(home / "data", tmp_path / "data")


def edit_text(name, old, new):
    def attack(run, home):
        body = (run / name).read_text()
        assert old in body
        (run / name).write_text(body.replace(old, new, 1))

    return attack


def edit_answers(run, home):
    with np.load(run / "retrievals.npz") as arrays:
        kept = dict(arrays)
    kept["index"][:, 0] = kept["index"][:, 1]
    np.savez_compressed(run / "retrievals.npz", **kept)


def swap(*names):
    def attack(run, home):
        for name in names:
            shutil.copy(home / "other" / name, run / name)

    return attack


def drop_hash(run, home):
    manifest = json.loads((run / "manifest.json").read_text())
    del manifest["sha256"]["signals.csv"]
    manifest["seal"] = records.seal_of(manifest)
    (run / "manifest.json").write_text(json.dumps(manifest))


def mend_hash_but_not_seal(run, home):
    edit_text("signals.csv", "ok", "gone")(run, home)
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["sha256"]["signals.csv"] = records.digest_file(run / "signals.csv")
    (run / "manifest.json").write_text(json.dumps(manifest))


def pickle_in(run, home):
    held = io.BytesIO()
    np.savez(held, index=np.array([print], dtype=object), similarity=np.ones(1), allow_pickle=True)
    (run / "retrievals.npz").write_bytes(held.getvalue())


def link_away(run, home):
    (run / "signals.csv").unlink()
    (run / "signals.csv").symlink_to(home / "other" / "signals.csv")


ATTACKS = {
    "a signal is edited": (edit_text("signals.csv", ",ok,", ",gone,"), "signals.csv: seal broken"),
    "a row is cut": (edit_text("signals.csv", "\n7,", "\n"), "signals.csv: seal broken"),
    "the answers are edited": (edit_answers, "retrievals.npz: seal broken"),
    "a pickle replaces the answers": (pickle_in, "retrievals.npz: seal broken"),
    "the map is edited": (edit_text("map_poses.csv", "\n3.0,", "\n3.5,"), "map_poses.csv: seal"),
    "the settings are edited": (edit_text("config.toml", "seed = 0", "seed = 1"), "config.toml: s"),
    "the manifest is another run's": (swap("manifest.json"), "seal broken: sha256"),
    "the signals are another run's": (swap("signals.csv"), "signals.csv: seal broken"),
    "signals and manifest are another run's": (
        swap("manifest.json", "signals.csv"),
        "seal broken: sha256",
    ),
    "a link leads to another run": (link_away, "signals.csv: seal broken"),
    "the hash is mended, the seal not": (mend_hash_but_not_seal, "manifest was edited"),
    "the hash is left out": (drop_hash, "signals.csv: seal broken"),
    "facts are edited": (
        edit_text("manifest.json", '"seed": 0', '"seed": 7'),
        "manifest was edite",
    ),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_the_judge_names_what_was_done_and_writes_nothing(attack, attacked, home, capsys):
    do, said = ATTACKS[attack]
    do(attacked, home)
    before = {path.name for path in attacked.iterdir()}
    assert main(["evaluate", str(attacked), "--truth", str(home / "data/truth")]) == 3
    line = capsys.readouterr().err.strip()
    assert said in line, line
    assert str(attacked) in line
    assert "\n" not in line
    assert {path.name for path in attacked.iterdir()} == before


def signals_without(run, column="t_s"):
    """Return signals.csv without one column."""
    lines = (run / "signals.csv").read_text().splitlines()
    at = lines[0].split(",").index(column)
    return [line.split(",")[:at] + line.split(",")[at + 1 :] for line in lines]


def test_a_truth_linked_into_query_is_not_read(home, data, tmp_path):
    (data / "query/truth").symlink_to(data / "truth", target_is_directory=True)
    (data / "query/query_poses.csv").symlink_to(data / "truth/query_poses.csv")
    os.link(data / "truth/query_poses.csv", data / "query/poses.csv")
    score(data, tmp_path / "run", SMALL)
    for name in records.SEALED:
        assert (tmp_path / "run" / name).read_bytes() == (home / "run" / name).read_bytes()
    hashes = [records.read_manifest(run)["sha256"] for run in (tmp_path / "run", home / "run")]
    assert hashes[0] == hashes[1]


def test_true_poses_linked_in_place_of_odometry_are_refused(data, tmp_path):
    (data / "query/odometry.csv").unlink()
    (data / "query/odometry.csv").symlink_to(data / "truth/query_poses.csv")
    with pytest.raises(InputError, match=r"odometry\.csv: is a link into .*truth"):
        score(data, tmp_path / "run", SMALL)


def test_an_input_linked_into_truth_is_refused(data, tmp_path):
    leak = np.load(data / "query/descriptors.npy")
    np.save(data / "truth/leak.npy", leak)
    (data / "query/descriptors.npy").unlink()
    (data / "query/descriptors.npy").symlink_to(data / "truth/leak.npy")
    with pytest.raises(InputError, match="truth"):
        score(data, tmp_path / "run", SMALL)


def test_inputs_may_be_links_to_elsewhere_and_give_the_same_bytes(home, data, tmp_path):
    store = tmp_path / "store"
    store.mkdir()
    for name in ("map/descriptors.npy", "query/odometry.csv"):
        kept = store / name.replace("/", "_")
        (data / name).rename(kept)
        (data / name).symlink_to(kept)
    score(data, tmp_path / "run", SMALL)
    for name in records.SEALED:
        assert (tmp_path / "run" / name).read_bytes() == (home / "run" / name).read_bytes()


@pytest.mark.parametrize("target", ["gone.npy", "descriptors.npy"])
@pytest.mark.parametrize("name", ["map/descriptors.npy", "query/odometry.csv"])
def test_a_link_to_nothing_or_to_itself_is_one_line(name, target, data, tmp_path, capsys):
    (data / name).unlink()
    (data / name).symlink_to(target if target == "gone.npy" else data / name)
    assert main(["score", str(data), "--out", str(tmp_path / "run"), "--no-progress"]) == 3
    line = capsys.readouterr().err.strip()
    assert name in line
    assert "\n" not in line


CLOCKS = {
    "counted from 1970": lambda t: t + 1.7e9,
    "jittered": lambda t: t + 0.4 * np.sin(7.0 * t),
    "ten times as fast": lambda t: 0.1 * t,
    "counted backwards from the end": lambda t: t - t[-1],
    "one pause": lambda t: t + 3600.0 * (t > t[len(t) // 2]),
}


def set_clock(path, clock):
    lines = path.read_text().splitlines()
    t = clock(np.array([float(line.split(",")[0]) for line in lines[1:]]))
    rows = [f"{s!r},{line.split(',', 1)[1]}" for s, line in zip(t.tolist(), lines[1:], strict=True)]
    path.write_text("\n".join([lines[0], *rows]) + "\n")


@pytest.mark.parametrize("clock", CLOCKS)
def test_stamps_are_no_side_channel(clock, home, data, tmp_path):
    for name in ("query/odometry.csv", "map/poses.csv"):
        set_clock(data / name, CLOCKS[clock])
    score(data, tmp_path / "run", SMALL)
    assert signals_without(tmp_path / "run") == signals_without(home / "run")
    answers = [(run / "retrievals.npz").read_bytes() for run in (tmp_path / "run", home / "run")]
    assert answers[0] == answers[1]
    assert (tmp_path / "run/signals.csv").read_bytes() != (home / "run/signals.csv").read_bytes()


def test_names_and_dates_of_files_are_no_side_channel(home, tmp_path):
    data = shutil.copytree(home / "data", tmp_path / "map_out_from_frame_20")
    for path in data.rglob("*"):
        os.utime(path, (1e9, 1e9))
    score(data, tmp_path / "run", SMALL)
    for name in records.SEALED:
        assert (tmp_path / "run" / name).read_bytes() == (home / "run" / name).read_bytes()


@pytest.mark.parametrize("poison", test_wall.POISON)
def test_rivals_ignore_whatever_the_truth_folder_holds(poison, data, tmp_path, monkeypatch):
    monkeypatch.setattr(rivals, "SYSTEMS", {"sue": sue, "mht": rivals.SYSTEMS["mht"]})
    score(data, tmp_path / "before", SMALL, rival_logs=1)
    test_wall.POISON[poison](data)
    score(data, tmp_path / "after", SMALL, rival_logs=1)
    before, after = ((tmp_path / side / "tracks.npz").read_bytes() for side in ("before", "after"))
    assert before == after


def test_linter_and_contracts_catch_a_baseline_that_knows_the_judge(tmp_path):
    ignore = shutil.ignore_patterns("__pycache__")
    for name in ("taojax", "data_specs"):
        shutil.copytree(test_wall.ROOT / name, tmp_path / name, ignore=ignore)
    shutil.copy(test_wall.ROOT / "pyproject.toml", tmp_path)
    path = tmp_path / "taojax/baselines/sequence.py"
    body = path.read_text()
    assert "import numpy as np\n" in body
    cheat = "import numpy as np\nfrom taojax.audit.labels import read_truth\n"
    path.write_text(body.replace("import numpy as np\n", cheat, 1))
    assert test_wall.ruff_objects(tmp_path)
    assert test_wall.contracts_object(tmp_path)
