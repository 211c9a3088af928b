"""The door between robot and judge: one folder, written once, sealed, read only if unbroken.

The seal is a hash without a key: it guards against accidents, such as a file that was edited, cut
short or mixed up with another run's. It does not guard against cheats, who can seal anew.
"""

import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taojax.errors import InputError
from taojax.files.atomic_write import locked_part
from taojax.files.dataset_info import DESCRIPTORS
from taojax.files.specs import fail, load_spec, open_file, read_bytes, read_npz, write_atomically
from taojax.files.tables import read_table, table_text
from taojax.risk import MapFacts

SCHEMA = 2
"""Of a run's manifest; 1 was taojax 0.1.0, whose runs have no delayed.csv."""

INPUTS = "inputs/"
"""Before the names of sensor files in a manifest."""

SEALED = ("config.toml", "delayed.csv", "map_poses.csv", "retrievals.npz", "signals.csv")
"""Files whose bytes the manifest vouches for, beside the hashes of the inputs."""

CARRIED = ("odometry.csv", "decisions.csv", "detector.toml", "tracks.npz")
"""Sealed like the others where they are there: odometry since runs can be explained, the rest where
it was asked for."""


class SealedTrack(NamedTuple):
    """What a rival says of every frame."""

    signal: np.ndarray
    """(T,) larger = more likely off the map; NaN where it was not run."""

    pose: np.ndarray
    """(T, 3) x [m], y [m], theta [rad]; zero without one."""

    has_pose: np.ndarray
    """(T,) bool."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A sealed run, verified. All the judge may hear of the robot."""

    signals: dict[str, np.ndarray]
    """Column -> (T,) as in data_specs/signals.toml; numbers float64, status str."""

    delayed: dict[str, np.ndarray]
    """Column -> (T,) as in data_specs/delayed.toml: what was known a lag later."""

    map_poses: dict[str, np.ndarray]
    """Column -> (M,) as in data_specs/map_poses.toml."""

    index: np.ndarray
    """(T, 100) retrieved map rows, best first, -1 = no candidate."""

    similarity: np.ndarray
    """(T, 100) their similarities."""

    config_toml: str
    """The resolved settings."""

    manifest: dict[str, Any]
    """What was run, on what, with which code."""

    tracks: dict[str, SealedTrack] | None = None
    """Rivals by name; None where they were not asked for."""

    decisions: dict[str, np.ndarray] | None = None
    """Run-time verdicts, as in data_specs/verdicts.toml; None where nobody decided."""


def signal_names() -> tuple[str, ...]:
    """Return the columns of signals.csv that are signals, in file order."""
    columns = load_spec("signals")["columns"]
    return tuple(column["name"] for column in columns if column.get("signal"))


def digest(data: bytes) -> str:
    """Return the SHA-256 of some bytes, hex."""
    return hashlib.sha256(data).hexdigest()


def digest_file(path: Path) -> str:
    """Return the SHA-256 of a file, hex, without holding it in memory.

    Raises:
        InputError: missing, no regular file, or unreadable.
    """
    with open_file(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def input_hashes(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Return file below the data folder -> SHA-256 of everything that a run was made from."""
    hashes = manifest["sha256"].items()
    return {n.removeprefix(INPUTS): h for n, h in hashes if n.startswith(INPUTS)}


def map_of(manifest: Mapping[str, Any]) -> MapFacts | None:
    """Return which map a run was scored on; None where an older manifest does not say."""
    hashes = input_hashes(manifest)
    if "map/poses.csv" not in hashes or "map_spacing_m" not in manifest:
        return None
    seen = next((hashes[name] for name, _ in DESCRIPTORS if name in hashes), "")
    spacing_m, recall = float(manifest["map_spacing_m"]), float(manifest["map_recall"])
    return MapFacts(hashes["map/poses.csv"], seen, spacing_m, recall)


def code_digest() -> str:
    """Return the SHA-256 of the sources of this package, hex."""
    package = Path(__file__).parents[1]
    return digest(b"".join(path.read_bytes() for path in sorted(package.rglob("*.py"))))


def seal_of(manifest: Mapping[str, Any]) -> str:
    """Return the seal that a manifest should carry: the hash of all its other entries."""
    body = {key: value for key, value in manifest.items() if key != "seal"}
    return digest(json.dumps(body, sort_keys=True).encode())


def _refuse_if_held(out: Path) -> None:
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise InputError(f"{out}: already holds files; choose a new --out")


def refuse_if_taken(out: Path) -> None:
    """Check, before the work of minutes, that a run may be written to `out`.

    Raises:
        InputError: `out` is a file, already holds something, or could not be written.
    """
    try:
        _refuse_if_held(out)
        first = out / "run"
        while not first.parent.exists():
            first = first.parent
        with locked_part(first, is_folder=True):
            pass
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another") from error


def publish(out: Path, files: Mapping[str, bytes]) -> None:
    """Write a whole folder at once: temporary name, fsync, rename.

    Args:
        out: the folder to make; must be absent or empty.
        files: relative name -> bytes.

    Raises:
        InputError: `out` is taken (also by a process that was quicker), or cannot be written.
    """
    _refuse_if_held(out)
    try:
        with locked_part(out, is_folder=True) as part:
            for name, raw in files.items():
                write_atomically(part / name, raw)
            # Renaming onto an empty folder is allowed, onto a filled one it fails: one writer wins.
            part.rename(out)
        folder = os.open(out.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)
    except OSError as error:
        _refuse_if_held(out)
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another") from error


def archive(**arrays: Any) -> bytes:
    """Return arrays of numbers as a compressed npz file."""
    held = io.BytesIO()
    # NumPy 2.0 would take a flag that forbids pickles for one more array.
    np.savez_compressed(held, **arrays)
    return held.getvalue()


def write_run(  # noqa: PLR0913 - one argument per sealed thing
    out: Path,
    *,
    signals: Mapping[str, np.ndarray],
    delayed: Mapping[str, np.ndarray],
    map_poses: Mapping[str, np.ndarray],
    index: np.ndarray,
    similarity: np.ndarray,
    config_toml: str,
    manifest: Mapping[str, Any],
    odometry: bytes | None = None,
    decisions: Mapping[str, np.ndarray] | None = None,
    calibration_toml: str | None = None,
    tracks: Mapping[str, SealedTrack] | None = None,
) -> dict[str, Any]:
    """Seal one run.

    Args:
        out: folder to make; must be absent or empty.
        signals: column -> (T,); every column of data_specs/signals.toml.
        delayed: the same of data_specs/delayed.toml.
        map_poses: column -> (M,).
        index: (T, 100) integers, -1 = no candidate.
        similarity: (T, 100).
        config_toml: resolved settings.
        manifest: facts about the run; `sha256` may already hold hashes of the inputs.
        odometry: bytes of query/odometry.csv, unchanged: a copy that rounds is another input.
        decisions: columns of data_specs/verdicts.toml.
        calibration_toml: the calibration that decided.
        tracks: rivals by name, where they were asked for.

    Returns:
        The manifest as sealed.

    Raises:
        InputError: `out` is taken or unwritable, or a signal is not finite.
    """
    files = {
        "config.toml": config_toml.encode(),
        "map_poses.csv": table_text("map_poses", map_poses).encode(),
        "retrievals.npz": archive(
            index=index.astype(np.int32), similarity=similarity.astype(np.float32)
        ),
        "signals.csv": table_text("signals", signals).encode(),
        "delayed.csv": table_text("delayed", delayed).encode(),
    }
    if odometry is not None:
        files["odometry.csv"] = odometry
    if calibration_toml is not None:
        files["detector.toml"] = calibration_toml.encode()
    if decisions is not None:
        files["decisions.csv"] = table_text("verdicts", decisions).encode()
    if tracks is not None:
        files["tracks.npz"] = archive(
            signal=np.stack([t.signal for t in tracks.values()]).astype(np.float32),
            pose=np.stack([t.pose for t in tracks.values()]).astype(np.float32),
            has_pose=np.stack([t.has_pose for t in tracks.values()]).astype(np.uint8),
        )
        manifest = {**manifest, "tracks": list(tracks)}
    hashes = dict(manifest.get("sha256", {})) | {name: digest(raw) for name, raw in files.items()}
    sealed = {"schema": SCHEMA, **manifest, "sha256": hashes}
    sealed["seal"] = seal_of(sealed)
    files["manifest.json"] = (json.dumps(sealed, indent=2, sort_keys=True) + "\n").encode()
    publish(out, files)
    return sealed


def read_manifest(run: Path) -> dict[str, Any]:
    """Return a run's manifest after checking its own seal.

    Raises:
        InputError: missing, not JSON, of another schema, edited since, or of several scenarios.
    """
    path = run / "manifest.json"
    fix = "score the data set again"
    if run.is_dir() and not path.exists():
        within = sorted(inner.parent for inner in run.glob("*/manifest.json"))
        name = f"name one: {', '.join(map(str, within[-3:]))}" if within else "name another"
        raise fail(run, "holds no run (manifest.json)", name)
    try:
        manifest = json.loads(read_bytes(path))
    except ValueError as error:
        raise InputError(f"{path}: is not JSON; {fix}") from error
    if isinstance(manifest, dict) and "scenarios" in manifest:
        raise fail(run, "holds several scenarios", f"name one of them, such as {run}/default")
    if not isinstance(manifest, dict) or not isinstance(manifest.get("sha256"), dict):
        raise InputError(f"{path}: is not the manifest of a run; {fix}")
    if manifest.get("schema") == 1:
        raise InputError(f"{path}: was sealed by taojax 0.1.0, which had no final verdicts; {fix}")
    if manifest.get("schema") != SCHEMA:
        raise InputError(f"{path}: schema {manifest.get('schema')!r} is not {SCHEMA}; {fix}")
    if manifest.get("seal") != seal_of(manifest):
        raise InputError(f"{path}: seal broken, the manifest was edited; {fix}")
    return manifest


def _read_tracks(path: Path, names: list[str]) -> dict[str, SealedTrack]:
    arrays = read_npz(path, "tracks")
    parts = zip(arrays["signal"], arrays["pose"], arrays["has_pose"].astype(bool), strict=True)
    return {name: SealedTrack(*part) for name, part in zip(names, parts, strict=True)}


def read_run(run: Path) -> Run:
    """Read a sealed run, or refuse if a byte has changed since.

    Raises:
        InputError: a sealed file is missing, changed or malformed.
    """
    manifest = read_manifest(run)
    carried = {name: run / name for name in CARRIED if name in manifest["sha256"]}
    for name in (*SEALED, *carried):
        want, got = manifest["sha256"].get(name), digest_file(run / name)
        if got != want:
            what = f"seal broken: sha256 {got[:12]}... is not {str(want)[:12]}..."
            raise InputError(f"{run / name}: {what}; score the data set again")
    decisions, tracks = carried.get("decisions.csv"), carried.get("tracks.npz")
    arrays = read_npz(run / "retrievals.npz", "retrievals")
    map_poses = read_table(run / "map_poses.csv", "map_poses")
    if arrays["index"].max() >= len(map_poses["t_s"]):
        raise InputError(f"{run / 'retrievals.npz'}: names map rows that map_poses.csv has not")
    return Run(
        signals=read_table(run / "signals.csv", "signals"),
        delayed=read_table(run / "delayed.csv", "delayed"),
        map_poses=map_poses,
        index=arrays["index"],
        similarity=arrays["similarity"],
        config_toml=(run / "config.toml").read_text(encoding="utf-8"),
        manifest=manifest,
        decisions=decisions and read_table(decisions, "verdicts"),
        tracks=tracks and _read_tracks(tracks, manifest["tracks"]),
    )
