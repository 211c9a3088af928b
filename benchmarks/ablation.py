"""What each ingredient is worth: one is taken away at a time, everything else stays.

Settings are changed through the configuration; ingredients that are no setting are swapped in the
module that owns them and put back. Signals of one replay (adaptive memory against a fading window,
parts of the fused probability) come from its own columns.
"""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.entrants import Field, field_of, stream
from benchmarks.sets import DataSet, recipes
from taojax import detector
from taojax.audit import calibration, metrics
from taojax.config import AuditConfig, Config, StreamConfig
from taojax.core import association
from taojax.runtime import joint
from taojax.runtime.maps import map_tables

SETTINGS: dict[str, dict[str, Any]] = {
    "all ingredients": {},
    "rank instead of joint": {"association": "rank"},
    "half the seeds": {"joint_seeds": 8},
    "twice the seeds": {"joint_seeds": 30},
    "short window (20)": {"joint_window": 20, "memory_frames": 7.0},
    "no heading prior": {"kappa_spacings": 0.0},
    "half delta": {"delta_spacings": 1.5},
    "twice delta": {"delta_spacings": 6.0},
}


def _one_direction(*args: Any) -> jax.Array:
    seeds = _SEEDS(*args)
    n = (len(seeds) - 2) // 2
    # The reversed half repeats the forward half, so that every shape stays.
    return seeds.at[n : 2 * n].set(seeds[:n])


def _nothing_carried(*args: Any) -> jax.Array:
    seeds = _SEEDS(*args)
    return seeds.at[-2:].set(seeds[0])


_SEEDS = joint.seeds_of
SWAPS: dict[str, tuple[Any, str, Any]] = {
    "one travel direction": (joint, "seeds_of", _one_direction),
    "no carried branch": (joint, "seeds_of", _nothing_carried),
    "two alternations": (association, "ROUNDS", 2),
    "no re-fit": (association, "ROUNDS", 0),
}


@contextlib.contextmanager
def _swapped(module: Any, name: str, value: Any) -> Iterator[None]:
    kept = getattr(module, name)
    setattr(module, name, value)
    jax.clear_caches()
    try:
        yield
    finally:
        setattr(module, name, kept)
        jax.clear_caches()


def _cell(signal: np.ndarray, field: Field) -> str:
    known = field.label != "grey"
    values, is_out = signal[known], (field.label == "map_out")[known]
    return f"{metrics.auroc(values, is_out):.3f} / {metrics.far_at_95(values, is_out):.2f}"


def _test_cell(columns: dict[str, np.ndarray], field: Field, recall: float) -> str:
    splits = field.split(columns)
    model = calibration.fit(splits.calibration, recall)
    known = splits.test.is_in | splits.test.is_out
    p = detector.probability(model, splits.test.signals)[known]
    return f"{metrics.auroc(p, splits.test.is_out[known]):.3f}"


def _columns(data: DataSet, config: StreamConfig) -> dict[str, np.ndarray]:
    records = stream(data, config)[0]
    return {name: np.asarray(values, float) for name, values in records.signals.items()}


def _rows(data: DataSet) -> dict[str, str]:
    """Return variant -> cell for one set."""
    audit = AuditConfig(r_in_m=data.r_in_m, r_out_m=data.r_out_m)
    field = field_of(data, Config(audit=audit))
    full, rows = _columns(data, StreamConfig()), {}
    recall = float(map_tables(data.map_poses, None, data.map_descriptors).recall)
    for name, settings in SETTINGS.items():
        columns = full if not settings else _columns(data, StreamConfig(**settings))
        rows[f"tao: {name}"] = _cell(columns["tao"], field)
    rows["tao: without the recursive filter"] = _cell(full["tao_align"], field)
    rows["tao: without it, fading window instead of adaptive memory"] = _cell(
        full["tao_window"], field
    )
    for name, swap in SWAPS.items():
        with _swapped(*swap):
            rows[f"tao: {name}"] = _cell(_columns(data, StreamConfig())["tao"], field)
    rows["probability, test half: all parts"] = _test_cell(full, field, recall)
    rows["probability, test half: prior of an unknown map"] = _test_cell(
        full, field, calibration.LIST_RECALL
    )
    for name in calibration.DISTINCT:
        # A constant column says nothing: the part is gone, the fit is the same.
        without = full | {name: np.zeros_like(full[name])}
        rows[f"probability, test half: without {name}"] = _test_cell(without, field, recall)
    return rows


def run(out: Path, data: Path, *, only: str = "", say: Callable[[str], None] = print) -> None:
    """Write ablation.md: variants down, data sets across.

    Args:
        out: folder to write into.
        data: folder of the real recordings; absent ones are skipped.
        only: data sets whose name contains this.
        say: where progress goes.
    """
    chosen = [
        recipe
        for recipe in recipes(data, quick=True, only=only)
        if recipe.name in REPRESENTATIVE or only
    ]
    table: dict[str, dict[str, str]] = {}
    for number, recipe in enumerate(chosen, start=1):
        for name, cell in _rows(recipe.make()).items():
            table.setdefault(name, {})[recipe.name] = cell
        say(f"[{number}/{len(chosen)}] {recipe.name}")
    names = [recipe.name for recipe in chosen]
    lines = ["| variant | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for name, cells in table.items():
        lines.append(f"| {name} | " + " | ".join(cells[n] for n in names) + " |")
    out.mkdir(parents=True, exist_ok=True)
    (out / "ablation.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    say(f"wrote {out / 'ablation.md'}")


REPRESENTATIVE = (
    "mit_corridor",
    "intel_lab",
    "tuc_corridor_mapout",
    "simulated/default/0",
    "range/alias 0.7/100",
)
"""Weak and strong descriptors, lists, the paper's world, and one where everything aliases."""
