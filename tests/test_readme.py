"""The README's code runs as printed."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop, motions

import taojax
from taojax.cli import main

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.S)


def test_bring_your_own_data_runs_as_printed(rng, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places, queries = loop(30), loop(24)
    names = {
        "map_poses": np.c_[np.arange(30), places],
        "odometry": np.c_[np.arange(24), motions(queries)],
        "query_poses": np.c_[np.arange(24), queries],
        "map_descriptors": rng.normal(size=(30, 8)).astype(np.float32),
        "query_descriptors": rng.normal(size=(24, 8)).astype(np.float32),
    }
    exec(BLOCKS[0], names)
    flags = ["--window", "6", "--branches", "5", "--no-progress", "--out", "run"]
    assert main(["score", "my_data", *flags]) == 0
    assert len((tmp_path / "run/signals.csv").read_text().splitlines()) == 25


def test_the_robot_program_runs_as_printed(rng):
    names = {
        "map_poses": loop(30),
        "map_descriptors": rng.normal(size=(30, 8)).astype(np.float32),
        "odometry": jnp.array([1.0, 0.0, 0.1]),
        "index": jnp.arange(20),
        "similarity": jnp.linspace(0.9, 0.1, 20),
    }
    exec(BLOCKS[1], names)
    assert taojax.STATUSES[int(names["record"].status)] == "warming_up"


def test_every_verb_of_the_readme_exists(capsys):
    verbs = set(re.findall(r"`taojax ([a-z]+)\b", README))
    assert verbs >= {"audit", "score", "evaluate", "kidnap", "sweep", "convert", "inspect"}
    for verb in verbs:
        with pytest.raises(SystemExit) as stop:
            main([verb, "--help"])
        assert not stop.value.code
    capsys.readouterr()
