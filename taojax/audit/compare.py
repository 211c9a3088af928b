"""Judged runs of one recording side by side: what is beyond chance, in words and figures."""

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taojax.audit import figures, metrics, tables
from taojax.audit.figures import Picture, csv_text, picture
from taojax.errors import InputError
from taojax.files.records import input_hashes, publish, read_run
from taojax.files.specs import fail, load_spec, read_bytes
from taojax.files.tables import read_frames, read_table
from taojax.plots import INK, PALE

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
        Scope(name, frame, metrics.block_weights(len(frame), block, most, seed))
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
        drawn = metrics.weighted_separation(values[known], is_out[known], scope.weights[:, known])
        point = {"auroc": metrics.auroc, "far_at_95": metrics.far_at_95}
        for name in SEPARATIONS:
            value = point[name](values[known], is_out[known])
            found[name] = value, np.asarray(getattr(drawn, name))
    threshold = run.thresholds[signal]
    if scope.name == "test" and not np.isnan(threshold):
        accepted = (values <= threshold).astype(float)
        for name, chosen, hit in (("far", is_out, accepted), ("frr", is_in, 1.0 - accepted)):
            if chosen.any():
                drawn_rate = metrics.weighted_mean(hit[chosen], scope.weights[:, chosen])
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
                    low, high = metrics.interval(ours[name][1] - theirs[name][1])
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


FEW_EXCURSIONS = 10
"""Below so many excursions off the map the block bootstrap is too sure of itself."""

MEASURES = {
    "auroc": ("AUROC", "higher is better"),
    "far_at_95": ("FAR at 95 % in-map acceptance", "lower is better"),
    "far": ("FAR at the frozen threshold", "lower is better"),
    "frr": ("FRR at the frozen threshold", "lower is better"),
}
"""Measure -> how people call it, and which way is up."""

FINDINGS = {"better": ("#0072B2", "o"), "worse": ("#D55E00", "X")}
"""Finding -> colour and marker; the others are pale."""


def _table_rows(found: Comparison) -> list[dict[str, Any]]:
    names, columns = list(found.table), list(found.table.values())
    return [dict(zip(names, cells, strict=True)) for cells in zip(*columns, strict=True)]


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested settings as one level, `stream.window` and the like."""
    flat = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= {f"{name}.{key}": inner for key, inner in _flat(value).items()}
        else:
            flat[name] = value
    return flat


def _differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    return sorted(key for key in {*one, *other} if one.get(key) != other.get(key))


def _causes(run: Judged, reference: Judged) -> str:
    """Say in what two runs differ before anything is measured."""
    if run.manifest["seal"] == reference.manifest["seal"]:
        return f"{run.name} and {reference.name} carry the same seal: they are one run."
    ours, theirs = _flat(run.settings), _flat(reference.settings)
    parts = [
        f"{key} {ours.get(key, 'unset')} against {theirs.get(key, 'unset')}"
        for key in _differing(ours, theirs)
    ]
    inputs = (input_hashes(run.manifest), input_hashes(reference.manifest))
    parts += [f"other {name}" for name in _differing(*inputs)]
    facts = ("code", "device", "versions")
    changed = [key for key in facts if run.manifest.get(key) != reference.manifest.get(key)]
    parts += [f"other {key}" for key in changed]
    what = "; ".join(parts) if parts else "neither settings, inputs, code nor machine"
    return f"{run.name} differs from {reference.name} in: {what}."


def _told(rows: list[dict[str, Any]]) -> str:
    """Say one finding about one signal on one set of frames."""
    first = rows[0]
    where = "held-out" if first["frames"] == "test" else "labelled"
    parts = [
        f"{MEASURES[row['measure']][0]} {row['value']:.3f} against {row['reference_value']:.3f} "
        f"({row['difference']:+.3f}, 95 % interval {row['difference_lo']:+.3f} to "
        f"{row['difference_hi']:+.3f})"
        for row in rows
    ]
    return (
        f"{first['run']} is {first['finding']} than {first['reference']} in {first['signal']} on "
        f"{first['n_in']:.0f} in-map and {first['n_out']:.0f} map-out {where} frames (prevalence "
        f"{first['prevalence']:.2f}): {'; '.join(parts)}."
    )


def _findings(rows: list[dict[str, Any]], run: Judged, reference: Judged) -> list[str]:
    """Say which differences of one run are beyond chance, and how many are not."""
    drawn = [row for row in rows if row["finding"] != "no interval"]
    if not drawn:
        return [f"{run.name} and {reference.name}: nothing can be compared, a class is missing."]
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in drawn:
        if row["finding"] in FINDINGS:
            key = tuple(row[name] for name in ("signal", "frames", "finding"))
            groups.setdefault(key, []).append(row)
    said = [_told(group) for group in groups.values()]
    n_beyond = sum(len(group) for group in groups.values())
    n_equal = sum(row["finding"] == "equal" for row in drawn)
    if n_equal == len(drawn):
        said.append(f"All {n_equal} differences from {reference.name} are zero.")
    else:
        rest = f"{len(drawn) - n_beyond} of {len(drawn)} differences from {reference.name}"
        zero = f", {n_equal} of them zero in every resample" if n_equal else ""
        said.append(f"{rest} are within chance{zero}.")
    if lost := len(rows) - len(drawn):
        said.append(
            f"{lost} differences have no interval: a class, a threshold, or resamples that hold "
            "both classes are missing."
        )
    return said


def _limits(found: Comparison, scope: Scope) -> list[str]:
    """Say how far the intervals can be believed."""
    label = found.runs[0].label[scope.frame]
    n_intervals = int(np.sum(found.table["finding"] != "no interval"))
    n_exits = len(metrics.find_exits(label).first) + int(
        next((one == "map_out" for one in label if one != "grey"), False)
    )
    said = [
        f"Intervals: {len(scope.weights)} resamples of blocks of {found.block_frames} frames, the "
        f"same for every run; thresholds and models stay frozen. Of {n_intervals} intervals at "
        "95 % about one in twenty leaves out zero by chance alone."
    ]
    if 0 < n_exits < FEW_EXCURSIONS:
        said.append(
            f"The map-out held-out frames lie in {n_exits} excursion(s); with fewer than "
            f"{FEW_EXCURSIONS} such intervals are too narrow."
        )
    return said


def sentences(found: Comparison) -> list[str]:
    """Return what was found, in plain words."""
    reference, rows, said = found.runs[0], _table_rows(found), []
    for run in found.runs[1:]:
        said.append(_causes(run, reference))
        said += _findings([row for row in rows if row["run"] == run.name], run, reference)
    test = next(scope for scope in found.scopes if scope.name == "test")
    if any(not np.array_equal(run.split, reference.split) for run in found.runs):
        said.append(
            f"The runs hold out different frames; measured are the {len(test.frame)} that all do."
        )
    return said + _limits(found, test)


def _panel(rows: list[dict[str, Any]], measure: str, *, ax: Axes) -> None:
    """Draw the differences of one measure, first row on top."""
    ax.axvline(0.0, color=INK, linewidth=0.8)
    for at, row in enumerate(rows):
        if np.isnan(row["difference"]):
            continue
        colour, marker = FINDINGS.get(row["finding"], (PALE, "D"))
        ax.hlines(at, row["difference_lo"], row["difference_hi"], color=colour, linewidth=1.6)
        ax.scatter(row["difference"], at, color=colour, marker=marker, s=36, zorder=3)
    name, way = MEASURES[measure]
    ax.set_title(name.replace(" at ", "\nat "), fontsize=9)
    ax.set_xlabel(f"difference ({way})", fontsize=8)
    reach = max(0.01, *(1.08 * abs(x) for x in ax.get_xlim()))
    ax.set(xlim=(-reach, reach), ylim=(len(rows) - 0.5, -0.5))
    ax.tick_params(labelsize=8)
    ax.locator_params(axis="x", nbins=5)
    ax.grid(alpha=0.25, axis="x")


def differences(found: Comparison) -> Picture:
    """Draw the differences on held-out frames with their intervals, one panel per measure."""
    held = [row for row in _table_rows(found) if row["frames"] == "test"]
    pairs = [(run.name, s) for run in found.runs[1:] for s in SIGNALS]
    pairs = [pair for pair in pairs if any((r["run"], r["signal"]) == pair for r in held)]
    figure = Figure(figsize=(11.0, 1.5 + 0.34 * max(3, len(pairs))), layout="constrained")
    axes = figure.subplots(1, len(MEASURES), sharey=True)
    drawn = []
    for ax, measure in zip(axes, MEASURES, strict=True):
        rows = [
            next(r for r in held if (r["run"], r["signal"], r["measure"]) == (*pair, measure))
            for pair in pairs
        ]
        _panel(rows, measure, ax=ax)
        drawn += rows
    several = len(found.runs) > 2
    names = [f"{run[-28:]}: {signal}" if several else signal for run, signal in pairs]
    axes[0].set_yticks(np.arange(len(pairs)), names)
    whose = "each run" if several else found.runs[1].name
    n_held = len(next(scope for scope in found.scopes if scope.name == "test").frame)
    title = f"{whose} minus {found.runs[0].name}, {n_held} held-out frames"
    figure.suptitle(title, fontsize=10)
    keep = (
        "run", "signal", "measure", "n_in", "n_out", "difference", "difference_lo",
        "difference_hi", "finding",
    )  # fmt: skip
    csv = csv_text({name: np.array([row[name] for row in drawn]) for name in keep})
    caption = "Bars: paired 95 % intervals. Blue circle better, orange cross worse, grey neither."
    return picture(figure, "compare", "Differences between runs", caption, csv)


def write(found: Comparison, out: Path, command: str) -> None:
    """Write page, tables and figure into a new folder.

    Args:
        found: by `compare`.
        out: folder to make; must be absent or empty.
        command: what was typed.

    Raises:
        InputError: `out` is taken or unwritable.
    """
    drawn = differences(found)
    facts = {
        "schema": 1,
        "command": command,
        "runs": {r.name: {"path": str(r.path), "seal": r.manifest["seal"]} for r in found.runs},
        "truth_sha256": found.runs[0].audit.get("truth_sha256"),
        "block_frames": found.block_frames,
        "n_bootstrap": len(found.scopes[0].weights),
        "seed": found.seed,
    }
    parts = [
        f"# {', '.join(run.name for run in found.runs)}",
        "\n".join(f"* {sentence}" for sentence in sentences(found)),
        f"![{drawn.title}](figures/{drawn.name}.png)",
        drawn.caption,
        load_spec("compare")["description"] + ".",
        tables.to_markdown("compare", found.table),
    ]
    files: dict[str, str | bytes] = {
        "compare.md": "\n\n".join(parts),
        "compare.json": json.dumps(facts, indent=2) + "\n",
        **tables.as_files("compare", found.table),
        **figures.as_files(drawn),
    }
    raw = {name: part.encode() if isinstance(part, str) else part for name, part in files.items()}
    publish(out, raw)
