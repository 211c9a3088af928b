"""Flags are spelled alike in all verbs; what is compiled is kept and never stands in the way."""

import dataclasses
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_cli import VERBS, fails

from taojax import cli
from taojax.cli import convert_flags, main, renamed
from taojax.cli.audit import Audit
from taojax.cli.common import Compiling, draws_bars, told

SETS = (
    "Sthereo", "Kri", "Mulran", "ComplexUrban", "Robotcar", "Vivid", "Folder", "Files", "Self"
)  # fmt: skip
PROGRAM = """
import sys
from taojax.cli.cache import keep_compiled
said = keep_compiled(is_wanted="off" not in sys.argv)
import jax
if "full" in sys.argv:
    import resource
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
number = float(jax.jit(lambda x: (x @ x.T).sum())(jax.numpy.ones((7, 5))))
print([said, number, jax.config.jax_compilation_cache_dir, jax.config.jax_enable_compilation_cache])
"""


def classes(verb):
    """The dataclasses that hold the flags of a verb."""
    if verb == "convert":
        return [getattr(convert_flags, name) for name in SETS]
    return [getattr(importlib.import_module(f"taojax.cli.{verb}"), verb.capitalize())]


def flags(verb):
    return {field.name for cls in classes(verb) for field in dataclasses.fields(cls)}


# Names


def test_the_first_page_names_every_verb_and_loads_no_parser():
    code = (
        "import sys\nfrom taojax.cli import main\nassert main(['--help']) == 0\n"
        "print([m for m in sys.modules if m in ('tyro', 'numpy', 'jax')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert set(cli.VERBS) == set(VERBS)
    assert all(f"  {verb} " in done.stdout for verb in VERBS)


@pytest.mark.parametrize("words", [[], ["grap"], ["--seed", "1"]])
def test_a_verb_that_is_none_is_a_usage_error_in_one_line(words, capsys):
    line = fails(capsys, 2, *words)
    assert line.endswith("`taojax --help` lists them")
    assert ("perhaps 'graph'" in line) == (words == ["grap"])
    assert "\n" not in line


def test_an_earlier_spelling_becomes_the_one_of_today():
    words = ["files", "OUT", "--map-views", "--map_views=m.npy", "map-views"]
    now, notes = renamed(words)
    new = ["--map-descriptors", "--map-descriptors=m.npy"]
    assert now == ["files", "OUT", *new, "map-views"]
    assert len(notes) == 2
    assert "--map-views is called --map-descriptors now" in notes[0]


def test_an_earlier_spelling_still_works_and_says_so(data_folder, tmp_path, capsys):
    words = ["convert", "files", str(tmp_path / "out")]
    words += ["--map-poses", str(data_folder / "map/poses.csv")]
    assert main([*words, "--map-views", str(data_folder / "map/descriptors.npy")]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "note: --map-views is called --map-descriptors now"
    assert (tmp_path / "out/map/descriptors.npy").is_file()


def test_no_flag_has_an_earlier_spelling():
    every = flags("audit") | flags("convert")
    plain = lambda flag: flag.removeprefix("--").removeprefix("no-").replace("-", "_")
    assert not every & {plain(old) for old in cli.RENAMED}
    assert every >= {plain(new) for new in cli.RENAMED.values()}


def test_what_draws_by_chance_takes_a_seed_and_what_takes_long_can_be_silent():
    seeded = {verb for verb in VERBS if "seed" in flags(verb)}
    silent = {verb for verb in VERBS if "progress" in flags(verb)}
    assert seeded == {
        "audit", "score", "evaluate", "kidnap", "sweep", "export", "convert", "simulate", "bench",
        "compare", "inspect", "graph",
    }  # fmt: skip
    assert silent == {
        "audit", "score", "evaluate", "kidnap", "sweep", "export", "describe", "explain", "rerun",
        "bench", "inspect", "graph",
    }  # fmt: skip
    assert {verb for verb in VERBS if issubclass(classes(verb)[0], Compiling)} == {
        "audit", "score", "evaluate", "kidnap", "sweep", "export", "explain", "rerun", "bench",
        "inspect", "watch", "doctor",
    }  # fmt: skip


@pytest.mark.parametrize(
    "words",
    [
        ("bench",), ("compare", "a", "b"), ("inspect", "x"), ("graph", "x"), ("simulate", "x"),
        ("score", "DATA"), ("convert", "self", "DATA", "out"),
    ],
)  # fmt: skip
def test_a_negative_seed_is_a_usage_error(words, data_folder, capsys):
    words = (str(data_folder) if word == "DATA" else word for word in words)
    line = fails(capsys, 2, *words, "--seed", "-1")
    assert "seed" in line
    assert "\n" not in line


def test_bench_times_the_drive_of_its_seed_and_can_be_silent(tmp_path, capsys, monkeypatch):
    drives = []
    monkeypatch.setattr("taojax.cli.bench.simulated_drive", lambda *args: drives.append(args))
    monkeypatch.setattr(
        "taojax.runtime.bench.measure", lambda drive, *, quick, say: [say("timing")][:0]
    )
    for name, words in {"loud": [], "silent": ["--no-progress", "--seed", "3"]}.items():
        assert main(["bench", "--out", str(tmp_path / name), *words]) == 0
        assert ("timing" in capsys.readouterr().err) == (name == "loud")
    assert [seed for _, seed in drives] == [0, 3]


# What is compiled


def compiled(*words, **environment):
    """Compile a program in a fresh interpreter; its line, folder, whether it is on, stderr."""
    bare = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XDG_", "TF_CPP_"))}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *words],
        env=bare | {"JAX_PLATFORMS": "cpu"} | environment,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    line, number, folder, is_on = eval(done.stdout.splitlines()[-1])
    assert number == 245.0
    return line, folder, is_on, done.stderr


def test_the_second_command_finds_what_the_first_has_compiled_or_makes_it_again(tmp_path):
    line, folder, is_on, said = compiled(XDG_CACHE_HOME=str(tmp_path))
    assert (line, is_on, said) == (None, True, "")
    assert Path(folder).parent == tmp_path / "taojax"
    kept = {path: path.read_bytes() for path in Path(folder).iterdir()}
    assert kept
    assert compiled(XDG_CACHE_HOME=str(tmp_path)) == (line, folder, is_on, "")
    # Half written by a process that runs beside, or before there was no room.
    for path, content in kept.items():
        path.write_bytes(content[: len(content) // 2])
    assert compiled(XDG_CACHE_HOME=str(tmp_path)) == (line, folder, is_on, "")


def test_a_full_disk_costs_time_alone(tmp_path):
    assert compiled("full", XDG_CACHE_HOME=str(tmp_path))[3] == ""


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    line, folder, is_on, said = compiled(XDG_CACHE_HOME=str(tmp_path / "file"))
    assert line.startswith("note: every command compiles again")
    assert "\n" not in line
    assert (folder, is_on, said) == (None, False, "")


def test_the_users_folder_wins_and_no_cache_wins_over_it(tmp_path):
    own = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "own"), "XDG_CACHE_HOME": str(tmp_path)}
    assert compiled(**own)[1:3] == (str(tmp_path / "own"), True)
    assert list((tmp_path / "own").iterdir())
    assert not (tmp_path / "taojax").exists()
    kept = len(list((tmp_path / "own").iterdir()))
    assert compiled("off", **own)[2] is False
    assert len(list((tmp_path / "own").iterdir())) == kept


def test_the_command_line_keeps_what_is_compiled_and_the_library_does_not(tmp_path):
    bare = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    bare |= {"JAX_PLATFORMS": "cpu", "XDG_CACHE_HOME": str(tmp_path)}
    found = {}
    for name, call in {
        "library": "import taojax; taojax.step",
        "command": "from taojax import cli; cli.main(['doctor', '--json'])",
        "no": "from taojax import cli; cli.main(['doctor', '--json', '--no-cache'])",
    }.items():
        code = (
            "from taojax.cli import doctor; doctor._step = lambda: {'error': 'left out'}\n"
            f"{call}\nprint(); print(doctor.json.dumps(doctor._jax()['cache']))"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], env=bare, capture_output=True, text=True, check=True
        )
        found[name] = json.loads(done.stdout.splitlines()[-1])
    assert found["library"] is found["no"] is None
    assert Path(found["command"]).parent == tmp_path / "taojax"


def test_a_command_goes_on_whether_or_not_it_keeps_what_it_compiles():
    from taojax.config import Config

    assert told(Audit(cache=False, progress=False), Config()) == told(Audit(), Config())


@pytest.mark.parametrize(("asked", "is_terminal", "drawn"), [
    (True, True, True), (True, False, False), (False, True, False),
])  # fmt: skip
def test_bars_are_drawn_for_people_alone(asked, is_terminal, drawn, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    assert draws_bars(asked) is drawn
