"""Judged runs of one recording side by side: which differences are beyond chance?"""

import json
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from taojax.audit import bootstrap, metrics, tables
from taojax.errors import InputError
from taojax.records import read_run
from taojax.specs import fail, read_bytes
from taojax.tables import read_frames, read_table

SIGNALS = ("top1", "tao", tables.FUSED)
SEPARATIONS = ("auroc", "far_at_95")
RATES = ("far", "frr")
_EXACT = 1e-9
"""Differences below it are rounding: the tables carry nine digits."""
_AGREES = 1e-6
"""How well metrics.csv and the frames behind it must agree."""


class Judged(NamedTuple):
    """A sealed run and what its judge wrote."""

    name: str
    """What it is called in the table."""

    path: Path
    manifest: dict[str, Any]
    settings: dict[str, Any]
    """config.toml."""

    audit: dict[str, Any]
    """audit.json."""

    label: Shaped[np.ndarray, " t"]
    split: Shaped[np.ndarray, " t"]
    signals: dict[str, np.ndarray]
    """Signal -> (t,); the probability only where it was calibrated."""

    thresholds: dict[str, float]
    """Frozen; NaN without one."""


class Scope(NamedTuple):
    """Frames on which all runs are measured, and how often each is drawn."""

    name: str
    """all or test."""

    frame: Int[np.ndarray, " n"]
    weights: Float[np.ndarray, "b n"]


class Comparison(NamedTuple):
    """What was found."""

    runs: tuple[Judged, ...]
    scopes: tuple[Scope, ...]
    block_frames: int
    seed: int
    """Of the resamples."""

    table: tables.Table
    """Columns of data_specs/compare.toml."""


def _audit_json(run: Path, seal: str) -> dict[str, Any]:
    """Return audit.json after checking that it judges this run and no other."""
    path, again = run / "audit.json", "judge the run again with `taojax evaluate`"
    if not path.is_file():
        raise fail(run, "is not judged, it holds no audit.json", again)
    try:
        audit = json.loads(read_bytes(path))
        judged = str(audit["run_seal"])
        int(audit["gap_frames"])
        [int(audit["audit"][name]) for name in ("block_frames", "n_bootstrap")]
    except (ValueError, KeyError, TypeError) as error:
        raise fail(path, "is not what the judge writes", again) from error
    if judged != seal:
        what = f"judges the run with the seal {judged[:12]}..., but this one is {seal[:12]}..."
        raise fail(path, what, again)
    return audit


def read_judged(run: Path, name: str) -> Judged:
    """Read a sealed run with its labels, probabilities and frozen thresholds.

    Args:
        run: folder made by `taojax audit`, or by `score` and `evaluate`.
        name: what to call it.

    Raises:
        InputError: broken seal, not judged, or files that do not belong together.
    """
    if not run.is_dir():
        raise fail(run, "no such run folder", "name one made by `taojax audit`")
    sealed = read_run(run)
    audit = _audit_json(run, sealed.manifest["seal"])
    n = len(sealed.signals["frame"])
    labels = read_frames(run / "labels.csv", "labels", n)
    verdicts = read_frames(run / "verdicts.csv", "verdicts", n)
    measured = read_table(run / "metrics.csv", "metrics")
    signals = {key: np.asarray(sealed.signals[key], float) for key in SIGNALS if key != "fused"}
    probability = np.asarray(verdicts["probability_map_out"], float)
    if not np.isnan(probability).any():
        signals[tables.FUSED] = probability
    rows = {str(signal): at for at, signal in enumerate(measured["signal"])}
    if missing := [signal for signal in signals if signal not in rows]:
        raise fail(run / "metrics.csv", f"has no row {missing[0]}", "judge the run again")
    judged = Judged(
        name=name,
        path=run,
        manifest=sealed.manifest,
        settings=tomllib.loads(sealed.config_toml),
        audit=audit,
        label=labels["label"],
        split=labels["split"],
        signals=signals,
        thresholds={signal: float(measured["threshold"][rows[signal]]) for signal in signals},
    )
    for signal, at in rows.items():
        if signal in signals:
            _check_agreement(judged, signal, {n: measured[n][at] for n in ("auroc", "auroc_test")})
    return judged


def _check_agreement(run: Judged, signal: str, said: dict[str, float]) -> None:
    """Refuse labels or metrics that were edited, or left over from another judgement."""
    for name, want in said.items():
        if name == "auroc" and signal == tables.FUSED:
            continue  # blank: it was fitted on half of the frames
        known = (run.label != "grey") & ((run.split == "test") | (name == "auroc"))
        is_out = run.label[known] == "map_out"
        one_class = is_out.all() or not is_out.any()
        got = np.nan if one_class else metrics.auroc(run.signals[signal][known], is_out)
        if np.isnan(got) != np.isnan(want) or abs(got - want) > _AGREES:
            what = f"{name} of {signal} is {want:.6g}, but labels and signals give {got:.6g}"
            raise fail(run.path / "metrics.csv", what, "judge the run again")


def _check_same(runs: Sequence[Judged]) -> None:
    """Refuse runs whose frames cannot be paired."""
    first = runs[0]
    for run in runs[1:]:
        pair, fix = f"{run.path} and {first.path}", "compare runs of one recording"
        if len(run.label) != len(first.label):
            what = f"{len(run.label)} and {len(first.label)} frames"
            raise InputError(f"{pair}: {what}; {fix}")
        if run.audit.get("truth_sha256") != first.audit.get("truth_sha256"):
            raise InputError(f"{pair}: were judged by different truths; {fix}")
        if not np.array_equal(run.label, first.label):
            frame = int(np.argmax(run.label != first.label))
            what = f"frame {frame} is {run.label[frame]} and {first.label[frame]}"
            fix = "judge both with the same --r-in and --r-out, on maps that cover the same ground"
            raise InputError(f"{pair}: {what}; {fix}")


def _scopes(runs: Sequence[Judged], seed: int) -> tuple[int, tuple[Scope, ...]]:
    """Return the block length, and the frames and resamples that all runs share."""
    block = max(max(int(r.audit["audit"]["block_frames"]), 2 * int(r.audit["gap_frames"]))
                for r in runs)  # fmt: skip
    most = max(int(run.audit["audit"]["n_bootstrap"]) for run in runs)
    held = np.flatnonzero(np.all([run.split == "test" for run in runs], axis=0))
    frames = {"all": np.arange(len(runs[0].label)), "test": held}
    return block, tuple(
        Scope(name, frame, bootstrap.block_weights(len(frame), block, most, seed))
        for name, frame in frames.items()
    )


def measure(run: Judged, signal: str, scope: Scope) -> dict[str, tuple[float, np.ndarray]]:
    """Measure one signal of one run.

    Args:
        run: a judged run.
        signal: one of its signals.
        scope: the frames, and how often each resample drew them.

    Returns:
        Measure -> (value, value per resample); measures that need a missing class are left out.
    """
    values, label = run.signals[signal][scope.frame], run.label[scope.frame]
    is_in, is_out, found = label == "in_map", label == "map_out", {}
    known = is_in | is_out
    if is_in.any() and is_out.any():
        drawn = bootstrap.weighted_separation(values[known], is_out[known], scope.weights[:, known])
        point = {"auroc": metrics.auroc, "far_at_95": metrics.far_at_95}
        for name in SEPARATIONS:
            value = point[name](values[known], is_out[known])
            found[name] = value, np.asarray(getattr(drawn, name))
    threshold = run.thresholds[signal]
    if scope.name == "test" and not np.isnan(threshold):
        accepted = (values <= threshold).astype(float)
        for name, chosen, hit in (("far", is_out, accepted), ("frr", is_in, 1.0 - accepted)):
            if chosen.any():
                drawn_rate = bootstrap.weighted_mean(hit[chosen], scope.weights[:, chosen])
                found[name] = float(hit[chosen].mean()), drawn_rate
    return found


def _finding(measure_name: str, low: float, high: float) -> str:
    if np.isnan(low):
        return "no interval"
    if max(abs(low), abs(high)) < _EXACT:
        return "equal"
    if low < _EXACT and high > -_EXACT:
        return "within chance"
    return "better" if (low > 0) == (measure_name == "auroc") else "worse"


def _rows(run: Judged, reference: Judged, scopes: Sequence[Scope]) -> list[dict[str, Any]]:
    rows = []
    for signal in SIGNALS:
        for scope in scopes:
            # The probability was fitted on the calibration frames: only held-out ones judge it.
            if scope.name == "all" and signal == tables.FUSED:
                continue
            if signal not in run.signals or signal not in reference.signals:
                continue
            ours, theirs = (measure(r, signal, scope) for r in (run, reference))
            label = run.label[scope.frame]
            n_in, n_out = int((label == "in_map").sum()), int((label == "map_out").sum())
            for name in SEPARATIONS + (RATES if scope.name == "test" else ()):
                row: dict[str, Any] = {
                    "run": run.name, "reference": reference.name, "signal": signal,
                    "measure": name, "frames": scope.name, "n_in": n_in, "n_out": n_out,
                    "finding": "no interval",
                }  # fmt: skip
                if n_in + n_out:
                    row["prevalence"] = n_out / (n_in + n_out)
                if name in ours and name in theirs:
                    low, high = bootstrap.interval(ours[name][1] - theirs[name][1])
                    row |= {
                        "value": ours[name][0], "reference_value": theirs[name][0],
                        "difference": ours[name][0] - theirs[name][0], "difference_lo": low,
                        "difference_hi": high, "finding": _finding(name, low, high),
                    }  # fmt: skip
                rows.append(row)
    return rows


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return what to call each run: its folder's name, or its path where names repeat."""
    own = [path.resolve().name for path in paths]
    called = [
        str(path) if own.count(name) > 1 else name for path, name in zip(paths, own, strict=True)
    ]
    # Commas, bars and percent signs would break a cell of some table.
    return [re.sub(r"[^\w./+-]", "_", name) for name in called]


def compare(paths: Sequence[Path], seed: int | None = None) -> Comparison:
    """Measure judged runs on the same frames, each against the first.

    Args:
        paths: two or more run folders of one recording, judged with the same radii.
        seed: of the resamples; None: the first run's.

    Raises:
        InputError: a run twice, not judged, with a broken seal, or of another recording.
    """
    if len({path.resolve() for path in paths}) < len(paths):
        raise InputError(f"{paths[-1]}: a run is named twice; name each once")
    runs = tuple(read_judged(*pair) for pair in zip(paths, names_of(paths), strict=True))
    _check_same(runs)
    seed = int(runs[0].audit.get("seed", 0)) if seed is None else seed
    block, scopes = _scopes(runs, seed)
    rows = [row for run in runs[1:] for row in _rows(run, runs[0], scopes)]
    return Comparison(runs, scopes, block, seed, tables.from_rows("compare", rows))
