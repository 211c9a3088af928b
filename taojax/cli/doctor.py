"""`taojax doctor`: is this machine set up, and what would make it faster?"""

import dataclasses
import importlib.util
import json
import os
import platform
import shutil
import time
from pathlib import Path
from typing import Any

from taojax.cli.common import Compiling

PACKAGES = (
    "taojax", "jax", "jaxlib", "equinox", "optimistix", "numpy", "pandas", "matplotlib",
    "scikit-learn",
)  # fmt: skip
"""Distributions whose version decides what happens."""

EXTRAS = {
    "export": (("flatbuffers",), "taojax export"),
    "graph": (("gtsam",), "taojax graph"),
    "ros": (("rosbags",), "odometry out of ROS bags"),
    "images": (("cv2", "onnxruntime"), "taojax describe, audit --map-images"),
    "view": (("rerun",), "taojax view"),
    "cuda": (("jax_cuda13_plugin",), "an NVIDIA GPU"),
    "notebooks": (("jupytext", "jupyterlab"), "the notebooks"),
    "test": (("pytest", "hypothesis", "beartype", "importlinter", "jaxlie"), "the tests"),
}
"""Extra -> modules that it brings, and what it is for."""

N_CALLS = 20
"""Calls after the first that are timed."""


@dataclasses.dataclass(frozen=True)
class Doctor(Compiling):
    """Look at this machine: versions, devices, cache, extras, and how long a step takes.

    Example: taojax doctor --json
    """

    json: bool = False
    """Print JSON instead of text."""


def run(args: Doctor) -> None:
    """Print what was found and what to do about it."""
    found = examine()
    print(json.dumps(found, indent=2) if args.json else page(found))


def examine() -> dict[str, Any]:
    """Return versions, machine, jax's settings, extras, the timed step, and advice."""
    found: dict[str, Any] = {
        "versions": {"python": platform.python_version()} | {n: _version(n) for n in PACKAGES},
        "machine": _machine(),
        "jax": _jax(),
        "extras": {name: _extra(name) for name in EXTRAS},
    }
    found["step"] = _step() if "error" not in found["jax"] else {"error": "jax does not start"}
    return found | {"advice": advice(found)}


def _version(name: str) -> str:
    from importlib import metadata

    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        if name != "taojax":
            return "absent"
        from taojax import __version__

        return f"{__version__} (not installed)"


def _machine() -> dict[str, Any]:
    # Cores this process may use: fewer than there are in a container or under taskset.
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    has_gpu = shutil.which("nvidia-smi") is not None or Path("/proc/driver/nvidia").is_dir()
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cores": os.cpu_count(),
        "usable_cores": usable,
        "load_1min": None if load is None else round(load, 2),
        "nvidia_gpu": has_gpu,
    }


def _jax() -> dict[str, Any]:
    """Return jax's devices and settings, or why it does not start."""
    try:
        import jax

        devices = [
            f"{device.platform} {device.id}: {device.device_kind}" for device in jax.devices()
        ]
    except Exception as error:  # whatever a broken installation raises is the finding
        return {"error": f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"}
    values = jax.config.values
    cache = values["jax_compilation_cache_dir"]
    is_on = bool(cache) and bool(values["jax_enable_compilation_cache"])
    return {
        "backend": jax.default_backend(),
        "devices": devices,
        "x64": bool(values["jax_enable_x64"]),
        "cache": str(cache) if is_on else None,
        "cache_min_compile_s": values["jax_persistent_cache_min_compile_time_secs"],
        "XLA_FLAGS": os.environ.get("XLA_FLAGS"),
        "JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS"),
    }


def _extra(name: str) -> dict[str, Any]:
    modules, purpose = EXTRAS[name]
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    command = f"python -m pip install 'taojax[{name}]'"
    return {"present": not missing, "missing": missing, "for": purpose, "command": command}


def _step() -> dict[str, Any]:
    """Time the first and the next calls of the step on a made-up map, with the default settings."""
    try:
        import jax
        import numpy as np

        import taojax

        config, rng = taojax.StreamConfig(), np.random.default_rng(0)
        angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
        poses = np.stack([60 * np.cos(angle), 60 * np.sin(angle), angle + np.pi / 2], axis=1)
        tables = taojax.map_tables(poses, config)
        state = taojax.init(config, tables)
        frame = taojax.Frame(
            *(
                jax.numpy.asarray(values)
                for values in (
                    np.array([1.9, 0.0, 0.03], np.float32),
                    rng.permutation(200)[:100].astype(np.int32),
                    np.linspace(0.9, 0.1, 100, dtype=np.float32),
                )
            )
        )
        took, is_finite = [], True
        for _ in range(1 + N_CALLS):
            start = time.perf_counter()
            state, record = jax.block_until_ready(taojax.step(config, tables, state, frame))
            took.append(time.perf_counter() - start)
            is_finite &= all(np.isfinite(value).all() for value in record.signals.values())
    except Exception as error:  # whatever a broken installation raises is the finding
        return {"error": f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"}
    following = sorted(took[1:])
    return {
        "first_s": round(took[0], 2),
        "next_ms": round(1e3 * following[len(following) // 2], 2),
        "slowest_next_ms": round(1e3 * following[-1], 2),
        "is_finite": bool(is_finite),
    }


def advice(found: dict[str, Any]) -> list[str]:
    """Return what to do, most important first; empty where all is well."""
    jax, machine, step = found["jax"], found["machine"], found["step"]
    said = []
    if absent := [name for name, version in found["versions"].items() if version == "absent"]:
        said.append(f"missing: {', '.join(absent)}; run: python -m pip install taojax")
    if "error" in jax:
        return [*said, "jax does not start; run: python -m pip install --upgrade jax"]
    if "error" in step or not step["is_finite"]:
        said.append("the step does not run here; please report it with `taojax doctor --json`")
    if machine["nvidia_gpu"] and jax["backend"] == "cpu":
        # The variable wins over whatever is installed.
        is_told = "cpu" in (jax["JAX_PLATFORMS"] or "").split(",")
        how = "unset JAX_PLATFORMS" if is_told else found["extras"]["cuda"]["command"]
        said.append(f"an NVIDIA GPU is there, but jax runs on the CPU; run: {how}")
    if jax["cache"] is None:
        said.append(
            "every command compiles again; drop --no-cache and JAX_ENABLE_COMPILATION_CACHE; where "
            "the cache folder cannot be written, export JAX_COMPILATION_CACHE_DIR=FOLDER"
        )
    if jax["x64"]:
        said.append("x64 is on: robot code needs float32 alone; run: unset JAX_ENABLE_X64")
    load, usable = machine["load_1min"], machine["usable_cores"]
    if load is not None and usable and load > usable:
        said.append(f"load {load} on {usable} cores: other programs run, times are too high")
    if usable and machine["cores"] and usable < machine["cores"]:
        said.append(
            f"this process may use {usable} of {machine['cores']} cores (taskset, container)"
        )
    return said


def _rows(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return section, name and value of every line."""
    jax, machine, step = found["jax"], found["machine"], found["step"]
    rows = [("versions", name, version) for name, version in found["versions"].items()]
    rows += [
        ("machine", "system", machine["system"]),
        ("machine", "cores", f"{machine['usable_cores']} usable of {machine['cores']}"),
        ("machine", "load, 1 min", str(machine["load_1min"])),
        ("machine", "NVIDIA GPU", "found" if machine["nvidia_gpu"] else "none found"),
    ]
    if "error" in jax:
        rows.append(("jax", "does not start", jax["error"]))
    else:
        rows += [("jax", "device", device) for device in jax["devices"]]
        rows.append(("jax", "x64", "on" if jax["x64"] else "off"))
        least = f", programs that take {jax['cache_min_compile_s']:g} s or more"
        rows.append(("jax", "compilation cache", jax["cache"] + least if jax["cache"] else "off"))
        rows += [("jax", name, jax[name]) for name in ("XLA_FLAGS", "JAX_PLATFORMS") if jax[name]]
    for name, extra in found["extras"].items():
        said = "present" if extra["present"] else f"absent: {extra['command']}"
        rows.append(("extras", name, f"{said} ({extra['for']})"))
    if "error" in step:
        rows.append(("step", "failed", step["error"]))
    else:
        rows += [
            ("step", "runs", "yes" if step["is_finite"] else "yes, but gives numbers not finite"),
            ("step", "first call", f"{step['first_s']:g} s, compiling what is not cached"),
            ("step", "next calls", f"{step['next_ms']:g} ms in the median of {N_CALLS}, "
             f"{step['slowest_next_ms']:g} ms at most"),
        ]  # fmt: skip
    return rows


def page(found: dict[str, Any]) -> str:
    """Return the findings as aligned text."""
    rows = _rows(found)
    width = max(len(name) for _, name, _ in rows)
    lines, section = [], ""
    for part, name, value in rows:
        lines += [] if part == section else [part]
        lines.append(f"  {name:{width}s}  {value}")
        section = part
    lines.append("advice")
    lines += [f"  {said}" for said in found["advice"] or ["nothing to do"]]
    return "\n".join(lines)
