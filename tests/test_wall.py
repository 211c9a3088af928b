"""The wall between robot and judge: six layers, and the planted cheats that each must catch."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
from conftest import write_folder

import taojax
from taojax.audit import calibration, labels, metrics
from taojax.config import Config, StreamConfig
from taojax.errors import InputError
from taojax.files import records
from taojax.runtime.score import score

ROOT = Path(taojax.__file__).parents[1]
SMALL = Config(stream=StreamConfig(window=6, branches=5))
FLAGS = ["--window", "6", "--branches", "5", "--association", "rank", "--no-progress"]
"""Rank compiles in a fraction of the time; what is tested does not depend on it."""

CHEATS = {
    "import at the top": ("runtime/stream.py", "import jax\n", "import jax\nimport taojax.audit\n"),
    "import inside a function": (
        "runtime/score.py",
        "    refuse_if_taken(out)\n",
        "    refuse_if_taken(out)\n    import taojax.audit\n",
    ),
    "importlib at run time": (
        "runtime/score.py",
        "    refuse_if_taken(out)\n",
        "    refuse_if_taken(out)\n    import importlib\n"
        '    importlib.import_module("taojax.aud" + "it")\n',
    ),
    "re-export from the face": (
        "__init__.py",
        "__version__ =",
        "import taojax.audit\n__version__ =",
    ),
    "a loader opens truth": (
        "runtime/observations.py",
        "    motion = stacked(",
        '    hint = folder / "truth/query_poses.csv"\n'
        "    odometry['dx_m'] += hint.stat().st_size if hint.exists() else 0\n"
        "    motion = stacked(",
    ),
    "the future leaks in": (
        "runtime/score.py",
        "    frames = jax.tree.map(np.asarray, frames)\n",
        "    frames = jax.tree.map(np.array, frames)\n"
        "    frames.similarity[:] -= np.mean(frames.similarity)\n",
    ),
}


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """A copy of the sources that cheats can be planted in."""
    copy = tmp_path_factory.mktemp("clean")
    ignore = shutil.ignore_patterns("__pycache__")
    for name in ("taojax", "data_specs"):
        shutil.copytree(ROOT / name, copy / name, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", copy)
    return copy


@pytest.fixture
def planted(clean, tmp_path):
    """Return a function that copies the sources and plants one cheat."""

    def plant(name):
        copy = tmp_path / "planted"
        shutil.copytree(clean, copy)
        if name is None:
            return copy
        where, old, new = CHEATS[name]
        path = copy / "taojax" / where
        body = path.read_text()
        assert body.count(old) >= 1, "the cheat no longer fits the code: plant it again"
        path.write_text(body.replace(old, new, 1))
        return copy

    return plant


def run(copy, *words):
    env = os.environ | {"PYTHONPATH": str(copy), "JAX_PLATFORMS": "cpu"}
    return subprocess.run(
        [sys.executable, *words], cwd=copy, env=env, capture_output=True, text=True, check=False
    )


def ruff_objects(copy):
    # Select the wall's rule alone: this test is about the wall, not about style.
    done = run(copy, "-m", "ruff", "check", "--no-cache", "--select", "TID251", "taojax")
    return "TID251" in done.stdout


def contracts_object(copy):
    code = "import sys; from importlinter.cli import lint_imports_command as c; c(['--no-cache'])"
    return run(copy, "-c", code).returncode != 0


def judge_appears(copy, folder):
    code = (
        "import sys; from taojax.cli import main; import pathlib\n"
        f"assert main(['score', {str(folder)!r}, '--out', 'run', *{FLAGS!r}]) == 0\n"
        "print('judged' if any(m.startswith('taojax.audit') for m in sys.modules) else 'apart')"
    )
    done = run(copy, "-c", code)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()[-1] == "judged"


SCORE_TWICE = """
from pathlib import Path
from taojax.config import Config, StreamConfig
from taojax.runtime.score import score
config = Config(stream=StreamConfig(window=6, branches=5, association="rank"))
for i, folder in enumerate({folders!r}):
    score(Path(folder), Path(f"run{{i}}"), config)
"""


def scored_twice(copy, *folders):
    code = SCORE_TWICE.format(folders=[str(folder) for folder in folders])
    done = run(copy, "-c", code)
    assert done.returncode == 0, done.stderr
    return [(copy / f"run{i}" / "signals.csv").read_bytes().splitlines() for i in range(2)]


@pytest.mark.parametrize("cheat", ["import at the top", "import inside a function"])
def test_linter_and_contracts_catch_a_plain_import(cheat, planted):
    copy = planted(cheat)
    assert ruff_objects(copy)
    assert contracts_object(copy)


def test_linter_catches_a_re_export(planted):
    assert ruff_objects(planted("re-export from the face"))


def test_linter_and_contracts_pass_the_clean_sources(clean):
    assert not ruff_objects(clean)
    assert not contracts_object(clean)


@pytest.mark.parametrize(
    "cheat", ["import at the top", "importlib at run time", "re-export from the face"]
)
def test_a_fresh_process_shows_a_hidden_judge(cheat, planted, data_folder):
    assert judge_appears(planted(cheat), data_folder)


def test_a_fresh_process_never_loads_the_judge(clean, data_folder):
    assert not judge_appears(clean, data_folder)


def shuffle_truth(folder):
    path = folder / "truth/query_poses.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *lines[:0:-1]]) + "\n")


POISON = {
    "absent": lambda folder: shutil.rmtree(folder / "truth"),
    "garbage": lambda folder: (folder / "truth/query_poses.csv").write_bytes(b"\xff\x00garbage"),
    "valid but shuffled": shuffle_truth,
}


@pytest.mark.parametrize("poison", POISON)
def test_signals_ignore_whatever_the_truth_folder_holds(poison, data_folder, tmp_path):
    score(data_folder, tmp_path / "before", SMALL)
    POISON[poison](data_folder)
    score(data_folder, tmp_path / "after", SMALL)
    for name in records.SEALED:
        before, after = ((tmp_path / side / name).read_bytes() for side in ("before", "after"))
        assert before == after


def test_poisoned_truth_shows_a_loader_that_peeks(planted, data_folder, tmp_path):
    blind = tmp_path / "blind"
    shutil.copytree(data_folder, blind)
    shutil.rmtree(blind / "truth")
    a, b = scored_twice(planted("a loader opens truth"), data_folder, blind)
    assert a != b


def change_future(folder, other, t):
    shutil.copytree(folder, other)
    path = other / "query/descriptors.npy"
    rows = np.load(path)
    rows[t + 1 :] = rows[t + 1 :][::-1] * 2 - 1
    np.save(path, rows)
    path = other / "query/odometry.csv"
    lines = path.read_text().splitlines()
    lines[t + 2 :] = [line.split(",")[0] + ",3.0,-2.0,0.5" for line in lines[t + 2 :]]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("t", [0, 7, 30])
def test_frames_after_t_change_no_row_up_to_t(t, data_folder, tmp_path):
    change_future(data_folder, tmp_path / "other", t)
    score(data_folder, tmp_path / "a", SMALL)
    score(tmp_path / "other", tmp_path / "b", SMALL)
    a, b = ((tmp_path / side / "signals.csv").read_bytes().splitlines() for side in "ab")
    assert a[: t + 2] == b[: t + 2]
    assert a[t + 2 :] != b[t + 2 :]


def test_a_log_that_ends_at_t_gives_the_same_rows(data_folder, tmp_path):
    t, other = 20, tmp_path / "other"
    shutil.copytree(data_folder, other)
    np.save(other / "query/descriptors.npy", np.load(other / "query/descriptors.npy")[: t + 1])
    path = other / "query/odometry.csv"
    path.write_text("\n".join(path.read_text().splitlines()[: t + 2]) + "\n")
    score(data_folder, tmp_path / "a", SMALL)
    score(other, tmp_path / "b", SMALL)
    a, b = ((tmp_path / side / "signals.csv").read_bytes().splitlines() for side in "ab")
    assert a[: t + 2] == b


def test_changed_futures_show_a_leak(planted, data_folder, tmp_path):
    change_future(data_folder, tmp_path / "other", 7)
    a, b = scored_twice(planted("the future leaks in"), data_folder, tmp_path / "other")
    assert a[:9] != b[:9]


def test_a_threshold_fitted_on_test_frames_or_scored_on_calibration_frames_is_refused():
    n = 40
    table = {name: np.linspace(0, 1, n) for name in records.signal_names()}
    label = np.array(["in_map", "map_out"] * (n // 2))
    splits = labels.split_frames(table, label, calibration_share=0.5, gap_frames=5)
    calibration.sigma_threshold(splits.calibration, "tao", 3.0)
    metrics.operate(splits.test, "tao", 0.5)
    with pytest.raises(jaxtyping.TypeCheckError):
        calibration.sigma_threshold(splits.test, "tao", 3.0)
    with pytest.raises(jaxtyping.TypeCheckError):
        metrics.operate(splits.calibration, "tao", 0.5)


def test_a_flipped_byte_in_the_signals_stops_the_judge(data_folder, tmp_path):
    score(data_folder, tmp_path / "run", SMALL)
    path = tmp_path / "run" / "signals.csv"
    raw = bytearray(path.read_bytes())
    raw[-20] ^= 1
    path.write_bytes(raw)
    with pytest.raises(InputError, match="seal broken"):
        records.read_run(tmp_path / "run")


def test_the_manifest_vouches_for_inputs_config_code_and_signals(data_folder, tmp_path):
    score(data_folder, tmp_path / "run", SMALL)
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    hashes = manifest["sha256"]
    assert {"config.toml", "signals.csv", "inputs/query/odometry.csv"} <= set(hashes)
    want = records.digest((data_folder / "query/odometry.csv").read_bytes())
    assert hashes["inputs/query/odometry.csv"] == want
    assert len(manifest["code"]) == 64


def test_two_runs_of_one_data_set_have_the_same_bytes(rng, tmp_path):
    folder = write_folder(tmp_path / "data", rng)
    score(folder, tmp_path / "a", SMALL)
    score(folder, tmp_path / "b", SMALL)
    for name in (*records.SEALED, "manifest.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_nothing_on_the_robots_side_takes_the_truth():
    names = {
        f"{path.relative_to(ROOT)}: {arg.arg}"
        for room in ("core", "runtime", "baselines")
        for path in sorted((ROOT / "taojax" / room).glob("*.py"))
        for arg in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(arg, ast.arg) and re.match("(true|truth)(_|$)", arg.arg)
    }
    assert not names


def test_jaxtyping_is_on():
    with pytest.raises(jaxtyping.TypeCheckError):
        StreamConfig(window="twenty")
