"""A verb started by a verb ends when its parent does, whatever ended that."""

import os
import signal
import subprocess
import sys
import time

import pytest
from conftest import write_folder

from taojax.cli import child
from taojax.cli.common import run_apart

STARTS = """
import sys
from taojax.cli import child
started = child.start()
started.give(sys.argv[1:])
print(started.process.pid, flush=True)
started.process.wait()
"""

RUNS = """
import sys
from taojax.cli import child
print("ready", flush=True)
child.HEARD_S = 0.1
child.run([sys.argv[1:]])
"""


@pytest.fixture(scope="module", autouse=True)
def kept_child():
    """Keep none: here it is told when interpreters begin and end."""


def is_alive(pid):
    """Tell whether a process runs; one that only waits to be reaped does not."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as stat:
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.fixture
def long_job(tmp_path, rng):
    """Words of a verb that is not done before it is looked at."""
    data = write_folder(tmp_path / "data", rng, n_query=2000)
    return ["score", str(data), "--out", str(tmp_path / "run"), "--no-progress"]


def begin(code, words):
    """Start a parent of a verb."""
    # Tests that run in the background ignore interrupts, and so would what they start.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [sys.executable, "-c", code, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
        )
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGTERM])
def test_a_child_ends_with_its_killed_parent(long_job, tmp_path, blow):
    with begin(STARTS, long_job) as parent:
        pid = int(parent.stdout.readline())
        time.sleep(0.5)
        assert is_alive(pid)
        parent.send_signal(blow)
        parent.wait()
        until = time.monotonic() + 20
        while is_alive(pid) and time.monotonic() < until:
            time.sleep(0.02)
        assert not is_alive(pid)
    assert not (tmp_path / "run").exists()


def test_an_interrupt_of_the_parent_alone_ends_the_child_too(long_job, tmp_path):
    with begin(RUNS, long_job) as parent:
        parent.stdout.readline()
        time.sleep(0.5)
        parent.send_signal(signal.SIGINT)
        # The child holds stderr open as long as it lives.
        _, said = parent.communicate(timeout=100)
    assert said.rstrip().endswith("KeyboardInterrupt")
    assert not (tmp_path / "run").exists()


def test_an_exit_code_comes_back(capfd):
    assert child.run([["nonsense"]]) == 2
    assert "nonsense" in capfd.readouterr().err


def test_verbs_run_one_after_another_in_as_few_interpreters_as_there_may_be(capfd, monkeypatch):
    begun, start = [], child.start
    monkeypatch.setattr(child, "start", lambda: begun.append(start()) or begun[-1])
    assert child.run([["watch", "--help"], ["score", "--help"], ["--help"]], most=2) == 0
    assert len(begun) == 2
    assert all(one.process.poll() is not None for one in begun)
    said = capfd.readouterr()
    assert all(f"usage: taojax {verb}" in said.out for verb in ("watch", "score", "VERB"))
    assert said.err == ""


def test_a_child_that_dies_at_work_is_told_by_its_signal(long_job, monkeypatch):
    start = child.start

    def started():
        one = start()
        one.process.send_signal(signal.SIGKILL)
        return one

    monkeypatch.setattr(child, "start", started)
    assert child.run([long_job]) == -signal.SIGKILL


def test_after_a_failure_no_other_is_begun_and_the_others_end(long_job, tmp_path, capfd):
    asked = []

    def commands():
        for words in (long_job, ["nonsense"], ["score", "never"]):
            asked.append(words[0])
            yield words

    assert child.run(commands(), most=2) == 2
    assert asked == ["score", "nonsense"]
    assert not (tmp_path / "run").exists()
    said = capfd.readouterr().err
    assert "nonsense" in said
    assert "interrupted" not in said


def test_a_child_that_was_killed_is_told_with_its_signal(monkeypatch, capsys):
    monkeypatch.setattr(child, "run", lambda commands, most: -signal.SIGKILL)
    with pytest.raises(SystemExit) as left:
        run_apart([["score"]])
    assert left.value.code == 137
    assert "SIGKILL" in capsys.readouterr().err
