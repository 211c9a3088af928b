"""`taojax doctor` tells what is there and gives the command for what is not."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import taojax
from taojax.cli import doctor, main

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def found():
    small = taojax.StreamConfig(window=4, branches=5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(taojax, "StreamConfig", lambda: small, raising=False)
        return doctor.examine()


def healthy(**changes):
    """Findings of a machine on which nothing is left to do."""
    found = {
        "versions": dict.fromkeys(("python", *doctor.PACKAGES), "1.0"),
        "machine": {
            "system": "Linux x86_64", "cores": 4, "usable_cores": 4, "load_1min": 0.5,
            "nvidia_gpu": False,
        },
        "jax": {
            "backend": "cpu", "devices": ["cpu 0: cpu"], "x64": False, "cache": "/cache",
            "cache_min_compile_s": 1.0, "XLA_FLAGS": None, "JAX_PLATFORMS": None,
        },
        "extras": {
            name: {"present": True, "missing": [], "for": why, "command": f"pip taojax[{name}]"}
            for name, (_, why) in doctor.EXTRAS.items()
        },
        "step": {"first_s": 5.0, "next_ms": 2.0, "slowest_next_ms": 3.0, "is_finite": True},
    }  # fmt: skip
    for part, values in changes.items():
        found[part] = found[part] | values
    return found


def test_the_machine_of_these_tests_runs_the_step(found):
    assert found["step"]["is_finite"]
    assert found["step"]["first_s"] > 0
    assert 0 < found["step"]["next_ms"] <= found["step"]["slowest_next_ms"]
    assert found["jax"]["devices"]
    assert found["jax"]["backend"] == "cpu"
    assert "absent" not in found["versions"].values()


def test_the_findings_are_json(found):
    assert json.loads(json.dumps(found)) == found


def test_the_text_is_aligned_and_names_every_part(found):
    lines = doctor.page(found).splitlines()
    sections = [line for line in lines if not line.startswith(" ")]
    assert sections == ["versions", "machine", "jax", "extras", "step", "advice"]
    told = lines[: lines.index("advice")]
    width = 2 + max(len(name) for _, name, _ in doctor._rows(found))
    assert {line[width : width + 2] for line in told if line.startswith(" ")} == {"  "}
    assert not any(line[width + 2] == " " for line in told if line.startswith(" "))
    assert all(name in "\n".join(lines) for name in (*doctor.PACKAGES, *doctor.EXTRAS))


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_the_verb_prints_what_was_examined(words, found, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "examine", lambda: found)
    assert main(["doctor", *words]) == 0
    said = capsys.readouterr().out
    assert said.strip() == (json.dumps(found, indent=2) if words else doctor.page(found))


ADVICE = {
    "no cache": ({"jax": {"cache": None}}, "export JAX_COMPILATION_CACHE_DIR="),
    "GPU, but jax for the CPU": ({"machine": {"nvidia_gpu": True}}, "run: pip taojax[cuda]"),
    "GPU, but jax told to use the CPU": (
        {"machine": {"nvidia_gpu": True}, "jax": {"JAX_PLATFORMS": "cpu"}},
        "run: unset JAX_PLATFORMS",
    ),
    "x64": ({"jax": {"x64": True}}, "unset JAX_ENABLE_X64"),
    "a busy machine": ({"machine": {"load_1min": 9.0}}, "load 9.0 on 4 cores"),
    "fewer cores": ({"machine": {"usable_cores": 2}}, "2 of 4 cores"),
    "a package is missing": ({"versions": {"pandas": "absent"}}, "missing: pandas"),
    "the step fails": ({"step": {"error": "XlaRuntimeError: no"}}, "the step does not run here"),
    "the step is not finite": ({"step": {"is_finite": False}}, "the step does not run here"),
}


@pytest.mark.parametrize("case", ADVICE)
def test_each_finding_has_its_advice_and_no_other(case):
    changes, said = ADVICE[case]
    advice = doctor.advice(healthy(**changes))
    assert len(advice) == 1
    assert said in advice[0]


def test_a_healthy_machine_gets_no_advice():
    assert doctor.advice(healthy()) == []
    assert doctor.page(healthy() | {"advice": []}).endswith("nothing to do")


def test_a_gpu_that_is_used_needs_no_advice():
    found = healthy(machine={"nvidia_gpu": True}, jax={"backend": "gpu"})
    assert doctor.advice(found) == []


def test_a_jax_that_does_not_start_is_told_and_nothing_else_is_tried(monkeypatch):
    import jax

    def broken():
        raise RuntimeError("no backend\nlong story")

    monkeypatch.setattr(jax, "devices", broken)
    found = doctor.examine()
    assert found["jax"] == {"error": "RuntimeError: no backend"}
    assert found["step"] == {"error": "jax does not start"}
    assert "jax does not start" in found["advice"][-1]
    assert "RuntimeError: no backend" in doctor.page(found)


def test_a_missing_package_is_a_finding_not_a_traceback():
    assert doctor._version("no-such-distribution") == "absent"


def test_a_missing_extra_names_its_modules_and_its_command(monkeypatch):
    monkeypatch.setitem(doctor.EXTRAS, "ros", (("rosbags", "no_such_module"), "bags"))
    extra = doctor._extra("ros")
    assert extra["missing"][-1] == "no_such_module"
    assert not extra["present"]
    assert extra["command"] == "python -m pip install 'taojax[ros]'"


def test_the_extras_are_those_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    # The developer's extra is for people who work on this project and read its own notes.
    assert set(doctor.EXTRAS) == set(project["optional-dependencies"]) - {"dev"}


def test_the_cache_is_seen_in_a_fresh_process(tmp_path):
    code = "from taojax.cli.doctor import _jax; print(_jax()['cache'])"
    env = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PLATFORMS": "cpu", "PATH": ""}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(tmp_path)
