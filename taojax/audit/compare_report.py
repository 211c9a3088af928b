"""What a comparison of runs found: in words, as a figure, and as a folder."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taojax.audit import figures, metrics, tables
from taojax.audit.compare import SIGNALS, Comparison, Judged, Scope
from taojax.audit.figures import Picture, csv_text, picture
from taojax.plots import INK, PALE
from taojax.records import input_hashes, publish
from taojax.specs import load_spec

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


def _rows(found: Comparison) -> list[dict[str, Any]]:
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
    reference, rows, said = found.runs[0], _rows(found), []
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
    held = [row for row in _rows(found) if row["frames"] == "test"]
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
