"""The step as StableHLO, for a program that has jax and numpy but not this package.

Map and settings are arguments of the artefact, not constants in it: then it holds what `step`
itself compiles, so that its records are the same bits, and it stays small whatever the map. For the
same reason there is one artefact per platform; a shared one chooses between them inside and gives
other bits.
"""

import importlib.util
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from taojax.config import Config, StreamConfig, VerdictConfig, to_toml
from taojax.errors import MissingExtraError
from taojax.files.records import SCHEMA, archive, digest, publish, refuse_if_taken, seal_of
from taojax.runtime.frames import STATUSES, Frame, StreamRecord
from taojax.runtime.maps import MapTables, map_tables
from taojax.runtime.observations import load_observations
from taojax.runtime.score import candidates
from taojax.runtime.stream import StreamState, init, step

EXAMPLE_FRAMES = 64
"""First frames of the data that travel with the artefact, with what `step` says of them."""

LOADER = Path(__file__).with_name("load_step.py")


class Inputs(NamedTuple):
    """What the artefact takes; the leaves in this order are its arguments."""

    stream: StreamConfig
    verdict: VerdictConfig
    map: MapTables
    state: StreamState
    frame: Frame


class Outputs(NamedTuple):
    """What it returns, in the same manner; the last array is all signals."""

    state: StreamState
    record: StreamRecord


def named(tree: Any) -> dict[str, np.ndarray]:
    """Return the leaves in order, each under a dotted name such as `state.filter.pace`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator=".")
    return {name(path): np.asarray(leaf) for path, leaf in leaves}


def artefact(inputs: Inputs, platform: str) -> bytes:
    """Lower `step` for a platform, which need not be the one at hand.

    Args:
        inputs: arrays of the wanted shapes and dtypes; their values are not looked at.
        platform: `cpu` or `cuda`.

    Returns:
        For `jax.export.deserialize`: a function of all leaves of `Inputs` that returns all leaves
        of `Outputs`.

    Raises:
        ImportError: flatbuffers is not installed.
    """
    treedef = jax.tree.structure(inputs)

    def flat(*leaves: jax.Array) -> list[jax.Array]:
        # Lists alone: whoever loads it has none of this package's types.
        given = jax.tree.unflatten(treedef, leaves)
        config = Config(stream=given.stream, verdict=given.verdict)
        return jax.tree.leaves(step(config, given.map, given.state, given.frame))

    shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(inputs)]
    return bytes(export.export(jax.jit(flat), platforms=(platform,))(*shapes).serialize())


def columns(record: StreamRecord) -> dict[str, Any]:
    """Return a record as the loader does: its fields and every signal under its own name."""
    fields = ("status", "map_index", "pose", "has_pose")
    return {**{name: getattr(record, name) for name in fields}, **record.signals}


def check_exportable(out: Path) -> None:
    """Check, before any work, that an artefact can be made and written.

    Raises:
        InputError: `out` is taken.
        MissingExtraError: flatbuffers is not installed.
    """
    refuse_if_taken(out)
    if importlib.util.find_spec("flatbuffers") is None:
        raise MissingExtraError(
            "export needs flatbuffers; run: python -m pip install 'taojax[export]'"
        )


def _listed(arrays: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    return [
        {"name": name, "shape": list(array.shape), "dtype": array.dtype.name}
        for name, array in arrays.items()
    ]


def export_step(
    dataset: Path,
    out: Path,
    config: Config,
    *,
    platforms: Sequence[str],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Export the step on the map of a data set, with all that is needed to run and check it.

    Args:
        dataset: a data folder, laid out as data_specs/README.md says; its first frames become the
            example.
        out: folder to make; must be absent or empty.
        config: settings; those of the judge are not used.
        platforms: any of `cpu` and `cuda`, one artefact each.
        facts: what the manifest says of this command, machine and code.

    Returns:
        The manifest as sealed.

    Raises:
        InputError: the data do not meet their spec, or `out` is taken.
        MissingExtraError: flatbuffers is not installed.
    """
    check_exportable(out)
    observations = load_observations(dataset)
    known = observations.descriptors and observations.descriptors[0]
    tables = map_tables(observations.map_xyt, config.stream, known)
    index, similarity = (a[:, : config.stream.branches] for a in candidates(observations))
    n = min(EXAMPLE_FRAMES, observations.trial_frames or EXAMPLE_FRAMES)
    log = Frame(*(jnp.asarray(a[:n]) for a in (observations.odometry, index, similarity)))
    settings = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32), (config.stream, config.verdict)
    )
    state, first = init(config, tables), jax.tree.map(lambda a: a[0], log)
    inputs = Inputs(settings[0], settings[1], tables, state, first)

    outputs = Outputs(*step(config, tables, state, first))
    said = [columns(outputs.record)]
    for t in range(1, len(log.odometry)):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], log)
        outputs = Outputs(*step(config, tables, outputs.state, frame))
        said.append(columns(outputs.record))
    example = {
        "frame": log,
        "record": {name: np.stack([row[name] for row in said]) for name in said[0]},
    }
    start = {name: a for name, a in named(inputs).items() if not name.startswith("frame.")}
    files = {
        "config.toml": to_toml(config).encode(),
        "load_step.py": LOADER.read_bytes(),
        "start.npz": archive(**start),
        "example.npz": archive(**named(example)),
        **{f"step.{p}.jaxexport": artefact(inputs, p) for p in dict.fromkeys(platforms)},
    }
    sealed = {
        "schema": SCHEMA,
        **facts,
        "kind": "export",
        "notes": list(observations.notes),
        "map_recall": float(tables.recall),
        "platforms": list(dict.fromkeys(platforms)),
        "inputs": _listed(named(inputs)),
        "outputs": _listed(named(outputs)),
        "signals": list(outputs.record.signals),
        "statuses": list(STATUSES),
        "sha256": observations.sha256 | {name: digest(raw) for name, raw in files.items()},
    }
    sealed["seal"] = seal_of(sealed)
    files["manifest.json"] = (json.dumps(sealed, indent=2, sort_keys=True) + "\n").encode()
    publish(out, files)
    return sealed
