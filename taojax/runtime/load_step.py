"""Runs an exported step: needs jax, numpy, flatbuffers and the files beside this one, not taojax.

step, state = load()
state, record = step(state, odometry, index, similarity)    # per frame

`python load_step.py` replays the recorded frames of example.npz and compares.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

HERE = Path(__file__).parent


def load(folder: Path = HERE) -> tuple[Callable[..., Any], list[jax.Array]]:
    """Return the step and the state before the first frame.

    Args:
        folder: made by `taojax export`.

    Returns:
        `step(state, odometry, index, similarity) -> (state, record)`. odometry: `(3,)` forward
        [m], left [m], yaw [rad] since the frame before; index: `(c,)` map rows, best first, -1 =
        no candidate; similarity: `(c,)`, at most 1; record: status (place in the statuses of
        manifest.json), map_index (-1 = no pose), pose `(3,)` x [m], y [m], theta [rad], has_pose,
        and every signal. And the state: a list of arrays, to be handed on from frame to frame.
        Candidates beyond those of the export do not count.

    Raises:
        FileNotFoundError: no artefact was exported for the platform that jax runs on.
    """
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    platform = jax.default_backend().replace("gpu", "cuda")
    artefact = bytearray((folder / f"step.{platform}.jaxexport").read_bytes())
    # Without jit every frame would be compiled again.
    call = jax.jit(export.deserialize(artefact).call)
    with np.load(folder / "start.npz") as arrays:
        start = {name: jax.device_put(array) for name, array in arrays.items()}
    state = [array for name, array in start.items() if name.startswith("state.")]
    fixed = list(start.values())[: -len(state)]
    room = manifest["inputs"][-1]["shape"][0]
    outputs = [output["name"].removeprefix("record.") for output in manifest["outputs"]]
    names = outputs[len(state) : -1]

    def step(
        state: list[jax.Array], odometry: np.ndarray, index: np.ndarray, similarity: np.ndarray
    ) -> tuple[list[jax.Array], dict[str, Any]]:
        n_missing = max(0, room - len(index))
        values = call(
            *fixed,
            *state,
            np.asarray(odometry, np.float32),
            np.pad(np.asarray(index, np.int32)[:room], (0, n_missing), constant_values=-1),
            np.pad(np.asarray(similarity, np.float32)[:room], (0, n_missing)),
        )
        *fields, signals = values[len(state) :]
        record = dict(zip(names, fields, strict=True))
        record |= dict(zip(manifest["signals"], np.asarray(signals), strict=True))
        return values[: len(state)], record

    return step, state


def compare(folder: Path = HERE) -> str:
    """Replay the example and say how far its records are from those of `taojax.step`."""
    step, state = load(folder)
    with np.load(folder / "example.npz") as arrays:
        example = dict(arrays)
    frames = [example.pop(f"frame.{name}") for name in ("odometry", "index", "similarity")]
    gap = dict.fromkeys(example, 0.0)
    for t, frame in enumerate(zip(*frames, strict=True)):
        state, record = step(state, *frame)
        for name, values in record.items():
            want = example[f"record.{name}"][t].astype(float)
            off = np.max(np.abs(np.asarray(values, float) - want) / (1.0 + np.abs(want)))
            gap[f"record.{name}"] = max(gap[f"record.{name}"], float(off))
    worst = max(gap, key=lambda name: gap[name])
    found = f"differ by at most {gap[worst]:.1e} ({worst})" if gap[worst] else "equal bit for bit"
    return f"{len(frames[0])} frames, {len(gap)} outputs each: {found}"


if __name__ == "__main__":
    print(compare())  # noqa: T201
