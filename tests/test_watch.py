"""Watching: the columns of `score` frame by frame, and nothing that a line can break."""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import write_folder
from judged import made_up

from taojax.cli import main
from taojax.config import Config, StreamConfig, VerdictConfig, to_toml
from taojax.errors import InputError
from taojax.files import records
from taojax.files.tables import read_table
from taojax.risk import to_toml as calibration_toml
from taojax.runtime.frames import Frame
from taojax.runtime.score import score
from taojax.runtime.watch import MOST_BYTES, LineError, Watch, load_map, parse

SHAPE = {"window": 6, "branches": 5}
LAG = VerdictConfig(lag=4, window_frames=4)
CONFIG = Config(stream=StreamConfig(**SHAPE), verdict=LAG)
RANK = Config(stream=StreamConfig(**SHAPE, association="rank"), verdict=LAG)
CALIBRATION = made_up("place", middle=-9.0, gain=2.0)
GOOD = {"odometry": [1.0, 0.0, 0.1], "index": [3, 4], "similarity": [0.9, 0.5]}


def feed(run):
    """The lines that a robot would have written during a sealed run."""
    table = read_table(run / "odometry.csv", "query_odometry")
    sealed = records.read_run(run)
    lines = []
    for t, t_s in enumerate(table["t_s"]):
        motion = [table[c][t] for c in ("dx_m", "dy_m", "dtheta_rad")]
        similarity = [float(f"{v:.9g}") for v in sealed.similarity[t]]
        line = {"t_s": t_s, "odometry": motion, "index": sealed.index[t].tolist()}
        lines.append(json.dumps(line | {"similarity": similarity}))
    return lines


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("watch")
    data = write_folder(folder / "data", np.random.default_rng(5))
    score(data, folder / "run", CONFIG, calibration=CALIBRATION)
    # Rank branches compile faster, and a process of its own has nothing compiled yet.
    (folder / "config.toml").write_text(to_toml(RANK))
    (folder / "calibration.toml").write_text(calibration_toml(CALIBRATION))
    (folder / "feed.jsonl").write_text("\n".join(feed(folder / "run")) + "\n")
    return folder


@pytest.fixture(scope="module")
def tables(folder):
    return load_map(folder / "data", CONFIG.stream)[0]


def watched(tables, raw, calibration=None, config=CONFIG):
    """Run bytes through a fresh watcher; return the answers and the summary."""
    watcher, out = Watch(config, tables, calibration), []
    watcher.run(io.BytesIO(raw), lambda line: out.append(json.loads(line)))
    return out, watcher.summary()


def kind(rows, name):
    """Return the lines of one kind: now or final."""
    return [row for row in rows if row.get("kind") == name]


def same_but_for_time(a, b):
    strip = lambda rows: [{k: v for k, v in row.items() if k != "latency_ms"} for row in rows]
    return strip(a) == strip(b)


@pytest.mark.parametrize("config", [CONFIG, RANK], ids=["joint", "rank"])
def test_the_columns_are_those_of_score(config, folder, tmp_path):
    score(folder / "data", tmp_path / "run", config, calibration=CALIBRATION)
    run = records.read_run(tmp_path / "run")
    tables = load_map(folder / "data", config.stream)[0]
    out, _ = watched(tables, (folder / "feed.jsonl").read_bytes(), CALIBRATION, config)
    want, decided = run.signals, run.decisions
    rows, finals = kind(out, "now"), kind(out, "final")
    assert len(out) == 100
    for found, end, silent in ((rows, "_now", "now_"), (finals, "", "")):
        assert [row["frame"] for row in found] == list(range(50))
        assert [row["verdict"] for row in found] == decided["verdict" + end].tolist()
        p = [row["probability_wrong"] for row in found]
        np.testing.assert_allclose(p, decided["probability_wrong" + end], rtol=1e-6)
        pose = np.array([row["pose"] or [np.nan] * 3 for row in found])
        names = [f"{name}{end}_{unit}" for name, unit in (("x", "m"), ("y", "m"), ("theta", "rad"))]
        sealed = np.stack([decided[name].astype(float) for name in names], axis=1)
        np.testing.assert_allclose(pose, sealed, rtol=1e-6, atol=1e-6)
        assert [row["t_s"] for row in found] == want["t_s"].tolist()
        assert [row["reason"] for row in found] == decided["reason" + end].tolist()
        index = (run.delayed if silent == "" else run.signals)[silent + "map_index"]
        assert [row["map_index"] for row in found] == [-1, -1, *index[2:]]
    assert [row["status"] for row in rows] == want["status"].tolist()
    np.testing.assert_allclose([row["tao"] for row in rows], want["tao"], rtol=1e-5, atol=1e-5)
    names = ("var_x_m2", "var_y_m2", "cov_xy_m2")
    sealed = np.stack([run.delayed[name] for name in names], axis=1)
    spread = [row["covariance"] for row in finals[2:]]
    np.testing.assert_allclose(spread, sealed[2:], rtol=1e-6, atol=1e-9)
    # Without a pose there is nothing that could be spread.
    assert [row["covariance"] for row in finals[:2]] == [None, None]
    assert len({row["verdict"] for row in finals}) >= 2
    accepted = decided["verdict_now"] == "accept"
    withdrawn = accepted & (decided["verdict"] != "accept")
    assert [row["withdrawn"] for row in finals] == withdrawn.tolist()


def test_a_final_line_comes_a_lag_later_and_the_last_ones_with_the_end(folder, tables):
    watcher = Watch(CONFIG, tables, CALIBRATION)
    due = {}
    for t, line in enumerate((folder / "feed.jsonl").read_bytes().splitlines()):
        now = watcher.answer(line)
        assert (now["kind"], now["frame"]) == ("now", t)
        for row in watcher.finals():
            assert row["kind"] == "final"
            due[row["frame"]] = t - row["frame"]
    rest = watcher.flush()
    assert [*due, *(row["frame"] for row in rest)] == list(range(50))
    # A block of half a lag is final once a lag has passed since its first frame.
    assert {due[t] for t in due if t > 0 and t % 2 == 0} <= set(range(4, 6))
    assert {row["kind"] for row in rest} == {"final"}
    assert len(rest) <= 5
    assert watcher.flush() == []


def test_a_program_gets_from_frames_what_a_pipe_gets_from_lines(folder, tables):
    lines = (folder / "feed.jsonl").read_bytes().splitlines()
    piped, own = (Watch(CONFIG, tables, CALIBRATION) for _ in range(2))
    seen = [json.loads(line) for line in lines]
    names = ("odometry", "index", "similarity")
    kinds = (jnp.float32, jnp.int32, jnp.float32)
    frames = [
        Frame(*(jnp.asarray(one[name], kind) for name, kind in zip(names, kinds, strict=True)))
        for one in seen
    ]
    assert same_but_for_time(
        [own.step(frame, one.get("t_s")) for frame, one in zip(frames, seen, strict=True)],
        [piped.answer(line) for line in lines],
    )
    finals = own.finals()
    assert finals == piped.finals()
    assert [row["frame"] for row in finals] == list(range(len(finals)))
    assert own.flush() == piped.flush()
    with pytest.raises(InputError, match=r"frame: index\[0\] is 5000, but the map has rows 0 to"):
        own.step(Frame(frames[0].odometry, frames[0].index + 5000, frames[0].similarity))


def test_an_acceptance_that_is_not_kept_is_withdrawn(folder, tables):
    # Causal answers are accepted throughout, final ones never.
    eager = CALIBRATION._replace(
        now=CALIBRATION.now._replace(weight=np.zeros(1), bias=-5.0),
        final=CALIBRATION.final._replace(weight=np.zeros(1), bias=0.3),
    )
    out, _ = watched(tables, (folder / "feed.jsonl").read_bytes(), eager)
    assert [row["verdict"] for row in kind(out, "now")] == ["abstain"] * 2 + ["accept"] * 48
    assert [row["verdict"] for row in kind(out, "final")] == ["abstain"] * 2 + ["reject"] * 48
    assert [row["withdrawn"] for row in kind(out, "final")] == [False] * 2 + [True] * 48


def test_lists_of_ones_own_frontend_keep_their_own_scale(folder, tmp_path):
    other = tmp_path / "data"
    shutil.copytree(folder / "data", other)
    sealed = records.read_run(folder / "run")
    np.savez(other / "query/retrievals.npz", index=sealed.index, similarity=sealed.similarity)
    score(other, tmp_path / "run", CONFIG)
    tables, words, _ = load_map(other, CONFIG.stream)
    assert "as they are" in words
    out, _ = watched(tables, (folder / "feed.jsonl").read_bytes())
    want = records.read_run(tmp_path / "run").signals["tao"]
    np.testing.assert_allclose([row["tao"] for row in kind(out, "now")], want, rtol=1e-5, atol=1e-5)


def test_without_a_calibration_the_shipped_one_decides(folder, tables, tmp_path):
    score(folder / "data", tmp_path / "run", CONFIG)
    decided = records.read_run(tmp_path / "run").decisions
    out, summary = watched(tables, (folder / "feed.jsonl").read_bytes())
    assert [row["verdict"] for row in kind(out, "final")] == decided["verdict"].tolist()
    assert [row["verdict"] for row in kind(out, "now")] == decided["verdict_now"].tolist()
    assert "accept" in decided["verdict"]
    assert summary.startswith("50 frames answered; latency p50 ")
    assert "p99" in summary
    assert all(row["latency_ms"] > 0 for row in kind(out, "now"))


def bad(**changes):
    return json.dumps(GOOD | changes).encode()


MALFORMED = {
    "not JSON": b"hello",
    "cut off": b'{"odometry": [1, 0',
    "not an object": b"[1, 2, 3]",
    "not UTF-8": b'{"odometry": "\xff"}',
    "deep": b"[" * 100_000,
    "NaN": b'{"odometry": [NaN, 0, 0], "index": [], "similarity": []}',
    "Infinity": b'{"odometry": [1, 0, 0], "index": [1], "similarity": [-Infinity]}',
    "1e999": b'{"odometry": [1e999, 0, 0], "index": [], "similarity": []}',
    "more digits than a float": bad(odometry=[10**400, 0, 0]),
    "more digits than Python reads": b'{"odometry": [' + b"9" * 9999 + b"]}",
    "null": bad(similarity=[None, 0.1]),
    "no odometry": json.dumps({"index": [], "similarity": []}).encode(),
    "two numbers": bad(odometry=[1.0, 2.0]),
    "four numbers": bad(odometry=[1.0, 2.0, 3.0, 4.0]),
    "too far": bad(odometry=[1e6, 0, 0]),
    "text": bad(odometry=["1", 0, 0]),
    "true": bad(index=[True, 1]),
    "fraction": bad(index=[0.5, 1]),
    "beyond the map": bad(index=[60, 1]),
    "below": bad(index=[-2, 1]),
    "far beyond": bad(index=[10**30, 1]),
    "unequal": bad(index=[1, 2, 3]),
    "rising": bad(similarity=[0.5, 0.9]),
    "above one": bad(similarity=[1.5, 0.9]),
    "odd stamp": bad(t_s="noon"),
    "too long": b" " * (2 * MOST_BYTES) + bad(),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_line_is_refused(name):
    if name == "too long":
        return
    with pytest.raises(LineError) as told:
        parse(MALFORMED[name], 60)
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 200


def test_malformed_lines_get_an_error_line_each_and_disturb_nothing(folder, tables):
    lines = (folder / "feed.jsonl").read_bytes().splitlines()
    clean, _ = watched(tables, b"\n".join(lines))
    mixed = [*lines[:20], *MALFORMED.values(), b"", b"   ", *lines[20:]]
    out, summary = watched(tables, b"\r\n".join(mixed))
    errors = [row for row in out if "error" in row]
    assert [row["line"] for row in errors] == list(range(21, 21 + len(MALFORMED)))
    assert all(set(row) == {"line", "error"} for row in errors)
    assert same_but_for_time([row for row in out if "error" not in row], clean)
    assert summary.startswith("50 frames")


def test_an_empty_stream_is_answered_by_nothing(tables):
    assert watched(tables, b"") == ([], "0 frames answered")
    assert watched(tables, b"\n\n") == ([], "0 frames answered")


def test_a_list_longer_than_what_is_used_is_cut_and_a_short_one_filled(tables):
    index = [t % 60 for t in range(5000)]
    similarity = np.linspace(0.9, 0.1, 5000).round(6).tolist()
    long = json.dumps(GOOD | {"index": index, "similarity": similarity}).encode()
    short = json.dumps(GOOD | {"index": index[:100], "similarity": similarity[:100]}).encode()
    assert same_but_for_time(watched(tables, long)[0], watched(tables, short)[0])
    seen = parse(json.dumps(GOOD).encode(), 60)
    assert seen.rows.tolist()[:3] == [3, 4, -1]
    assert len(seen.rows) == 100


def test_a_line_without_candidates_is_a_frame_like_any_other(tables):
    line = json.dumps({"odometry": [1, 0, 0], "index": [], "similarity": []})
    out, _ = watched(tables, "\n".join([line] * 4).encode(), CALIBRATION)
    out, finals = kind(out, "now"), kind(out, "final")
    assert len(finals) == 4
    assert {row["verdict"] for row in finals} == {"abstain"}
    assert {row["pose"] for row in finals} == {None}
    assert [row["status"] for row in out] == ["warming_up"] * 2 + ["no_candidates"] * 2
    assert {row["verdict"] for row in out} == {"abstain"}
    assert out[-1]["pose"] is None


def test_nothing_is_compiled_once_lines_come(folder, tables):
    from taojax.runtime import hindsight
    from taojax.runtime.stream import step

    watcher = Watch(CONFIG, tables, CALIBRATION)
    sizes = lambda: [made._cache_size() for made in (step, hindsight.advance)]
    before, many = sizes(), hindsight.finish._cached._cache_size()
    for line in (folder / "feed.jsonl").read_bytes().splitlines()[:20]:
        watcher.answer(line)
        watcher.finals()
    assert sizes() == before
    assert hindsight.finish._cached._cache_size() == many


def test_a_plain_map_folder_will_do(folder, tmp_path):
    for name in ("poses.csv", "descriptors.npy"):
        (tmp_path / name).write_bytes((folder / "data/map" / name).read_bytes())
    plain, words, _ = load_map(tmp_path, CONFIG.stream)
    assert str(tmp_path / "descriptors.npy") in words
    want = load_map(folder / "data", CONFIG.stream).tables
    assert float(plain.recall) == float(want.recall)
    (tmp_path / "descriptors.npy").unlink()
    assert "as they are" in load_map(tmp_path, CONFIG.stream).scale
    np.save(tmp_path / "descriptors.npy", np.ones((7, 3), np.float32))
    with pytest.raises(InputError, match="7 rows"):
        load_map(tmp_path, CONFIG.stream)


def test_a_folder_without_a_map_is_exit_3(tmp_path, capsys):
    assert main(["watch", str(tmp_path)]) == 3
    assert "poses.csv" in capsys.readouterr().err


def start(folder):
    words = ["watch", str(folder / "data"), "--config", str(folder / "config.toml")]
    words += ["--calibration", str(folder / "calibration.toml")]
    # A runner in the background ignores interrupts, and its children would inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        child = subprocess.Popen(
            [sys.executable, "-m", "taojax", *words], env=os.environ | {"JAX_PLATFORMS": "cpu"},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
    finally:
        signal.signal(signal.SIGINT, before)
    assert child.stderr.readline().startswith(b"compiling")
    assert child.stderr.readline().startswith(b"ready: map of 60 places")
    return child


def test_each_line_is_answered_at_once_and_an_interrupt_ends_with_a_summary(folder):
    child = start(folder)
    lines = (folder / "feed.jsonl").read_bytes().splitlines()
    for t in range(4):
        child.stdin.write(lines[t] + b"\n")
        child.stdin.flush()
        # Blocks for ever where the answer waits for more lines.
        assert json.loads(child.stdout.readline())["frame"] == t
    child.stdin.write(b"oops\n")
    child.stdin.flush()
    assert json.loads(child.stdout.readline())["line"] == 5
    child.send_signal(signal.SIGINT)
    _, err = child.communicate(timeout=60)
    assert child.returncode == 130
    assert b"4 frames answered; latency p50" in err
    assert b"Traceback" not in err


def test_a_reader_that_leaves_ends_it_quietly(folder):
    child = start(folder)
    child.stdout.close()
    with contextlib.suppress(BrokenPipeError):
        os.write(child.stdin.fileno(), (folder / "feed.jsonl").read_bytes()[:20_000])
    child.stdin.close()
    err = child.stderr.read()
    child.stderr.close()
    assert child.wait(timeout=60) == 0
    assert b"Traceback" not in err
    assert b"Exception" not in err
