"""Half-written parts: those of the dead are cleared, those of the living are left alone."""

import subprocess
import sys

import pytest

from taojax.files.atomic_write import clear_dead, locked_part
from taojax.files.records import publish
from taojax.files.specs import write_atomically

WRITER = """
import sys
from pathlib import Path
from taojax.files.atomic_write import locked_part
with locked_part(Path(sys.argv[1]), is_folder=sys.argv[2] == "folder") as part:
    print(part, flush=True)
    sys.stdin.read()
"""


def parts(folder):
    return sorted(path.name for path in folder.glob(".*.part"))


def writer(path, kind):
    """A process that holds a part of a path."""
    words = [sys.executable, "-c", WRITER, str(path), kind]
    child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline().strip()
    return child


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_part_stays_while_its_writer_lives_and_goes_when_it_was_killed(tmp_path, kind):
    with writer(tmp_path / "run", kind) as child:
        clear_dead(tmp_path / "run")
        with locked_part(tmp_path / "run", is_folder=True):
            assert len(parts(tmp_path)) == 2
        assert len(parts(tmp_path)) == 1
        child.kill()
        child.wait()
        assert len(parts(tmp_path)) == 1
        clear_dead(tmp_path / "run")
        assert parts(tmp_path) == []


@pytest.mark.parametrize("write", ["publish", "write_atomically"])
def test_writing_again_clears_what_a_killed_writer_left(tmp_path, write):
    left = tmp_path / ".run.0123456789ab.part"
    left.mkdir()
    (left / "signals.csv").write_text("half")
    (tmp_path / ".run.ba9876543210.part").write_text("half")
    publish(tmp_path / "run", {"a": b"1"}) if write == "publish" else write_atomically(
        tmp_path / "run", "1"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_parts_of_other_names_links_and_the_users_own_files_are_left_alone(tmp_path):
    names = {
        ".run.csv.0123456789ab.part", ".run.part", ".run.mine.part", "run.0123456789ab.part",
        ".Run.0123456789ab.part", ".run.0123456789ab.part.bak",
    }  # fmt: skip
    for name in names:
        (tmp_path / name).write_text("mine")
    (tmp_path / ".run.000000000000.part").symlink_to(tmp_path / ".run.part")
    clear_dead(tmp_path / "run")
    assert {path.name for path in tmp_path.iterdir()} == names | {".run.000000000000.part"}


def test_a_name_with_pattern_characters_is_taken_literally(tmp_path):
    (tmp_path / ".runs.0123456789ab.part").write_text("of runs")
    (tmp_path / ".run[s]*.0123456789ab.part").write_text("of run[s]*")
    clear_dead(tmp_path / "run[s]*")
    assert parts(tmp_path) == [".runs.0123456789ab.part"]


def fail_while_writing(path):
    with locked_part(path, is_folder=True) as part:
        (part / "half").write_text("1")
        raise ZeroDivisionError


def test_a_writer_that_fails_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError):
        fail_while_writing(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_clearing_where_there_is_no_folder_does_nothing(tmp_path):
    clear_dead(tmp_path / "none" / "run")
    assert list(tmp_path.iterdir()) == []
