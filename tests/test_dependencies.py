"""What the package needs is declared, agrees, and is not fetched over a network at run time."""

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from conftest import write_folder

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SOURCES = sorted((ROOT / "taojax").rglob("*.py"))

NETWORK = {"socket", "ssl", "http", "urllib", "ftplib", "smtplib", "requests", "httpx", "aiohttp"}

OFFLINE = """
import runpy, sys

def refuse(event, args):
    if event.startswith("socket."):
        raise RuntimeError(f"a socket was touched: {event}")

sys.addaudithook(refuse)
sys.argv = ["taojax", *sys.argv[1:]]
runpy.run_module("taojax", run_name="__main__")
"""
"""Python tells an audit hook of every socket before it is made; XLA's own code it does not see."""


def named(requirement):
    """Return the normalised name of a requirement."""
    return re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-")


DECLARED = {named(line) for line in PROJECT["dependencies"]}
OPTIONAL = {named(line) for lines in PROJECT["optional-dependencies"].values() for line in lines}


def modules(path):
    """Return the top names of all modules that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


def test_every_import_is_declared_or_comes_with_a_declared_package():
    own = {"taojax", "load_step"} | set(sys.stdlib_module_names)
    found = {name for path in SOURCES for name in modules(path)} - own
    homes = metadata.packages_distributions()
    carried = {
        named(line)
        for name in DECLARED
        for line in metadata.requires(name) or ()
        if "extra" not in line
    }
    known = DECLARED | OPTIONAL | carried
    unknown = {
        name for name in found if not {named(home) for home in homes.get(name, (name,))} & known
    }
    # faiss is measured beside ours where it happens to be installed.
    assert unknown <= {"faiss"}


def test_every_dependency_has_a_floor():
    for line in PROJECT["dependencies"]:
        assert re.fullmatch(r"[\w-]+>=[\d.]+", line), line


def test_nothing_in_the_package_imports_a_network():
    found = {path.name: NETWORK & set(modules(path)) for path in SOURCES}
    assert {name: names for name, names in found.items() if names} == {}


def test_what_is_installed_agrees_with_what_the_package_declares():
    if importlib.util.find_spec("pip") is None:
        pytest.skip("this environment has no pip")
    words = [sys.executable, "-m", "pip", "--disable-pip-version-check", "check"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    # Other people's packages may disagree in a shared environment; ours may not.
    ours = DECLARED | {"taojax"}
    assert [line for line in done.stdout.splitlines() if line and named(line) in ours] == []


def test_scoring_opens_no_socket(tmp_path):
    folder = write_folder(tmp_path / "data", np.random.default_rng(2), n_map=30, n_query=20)
    flags = ["--window", "4", "--branches", "5", "--association", "rank", "--no-progress"]
    words = ["score", str(folder), "--out", str(tmp_path / "run"), *flags]
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE, *words],
        cwd=ROOT,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["seal"]


@pytest.mark.parametrize("act", ["socket.socket()", "socket.create_connection(('localhost', 9))"])
def test_the_socket_guard_sees_a_socket(act):
    code = OFFLINE.replace(
        'runpy.run_module("taojax", run_name="__main__")', f"import socket; {act}"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "a socket was touched" in done.stderr
