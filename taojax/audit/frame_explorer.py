"""What the page shows of every frame: route, window, candidates and terms, packed to be small."""

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from taojax.audit.html import names_of_signals
from taojax.audit.judgement import Judgement
from taojax.audit.risk import FINAL, NOW
from taojax.audit.tables import FUSED
from taojax.files.specs import load_spec
from taojax.plots import OUTCOMES
from taojax.risk import probability

MOST_FRAMES = 10_000
"""Longer runs show every second, third, ... frame, and say so."""

_CANDIDATE_BYTES = 800_000
_LEAST_CANDIDATES = 5
_LEVELS = 65_535


def _packed(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def _floats(values: np.ndarray) -> str:
    # Six decimals of a signal of 1 would be noise; float32 holds seven digits in four bytes.
    with np.errstate(over="ignore"):
        return _packed(values, "<f4")


def _letters(values: np.ndarray, names: Mapping[str, str]) -> str:
    return "".join(names[str(value)] for value in values)


def _candidates(
    index: Int[np.ndarray, "t k"], similarity: Float[np.ndarray, "t k"]
) -> dict[str, Any]:
    """Pack the best candidates: rows of the map counted from 1 (0 = none), similarities scaled."""
    room = _CANDIDATE_BYTES * 3 // 4 // (4 * max(1, len(index)))
    k = min(index.shape[1], max(_LEAST_CANDIDATES, room))
    rows, alike = index[:, :k] + 1, similarity[:, :k].astype(float)
    known = alike[rows > 0]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    share = np.clip((np.where(rows > 0, alike, low) - low) / ((high - low) or 1.0), 0.0, 1.0)
    is_wide = bool(rows.size and rows.max() > _LEVELS)
    return {
        "k": k,
        "of": index.shape[1],
        "low": low,
        "high": high,
        "wide": is_wide,
        "row": _packed(rows, "<u4" if is_wide else "<u2"),
        "alike": _packed(np.round(share * _LEVELS), "<u2"),
    }


def _model(judgement: Judgement, names: list[str]) -> dict[str, Any]:
    """Return what turns features into the final answer's log odds of being wrong."""
    risk = judgement.calibration.final
    return {
        "columns": [names.index(name) for name in risk.columns],
        "mean": risk.mean.tolist(),
        "scale": risk.scale.tolist(),
        "weight": risk.weight.tolist(),
        "threshold": None if np.isnan(risk.level) else float(risk.level),
    }


def _signals(judgement: Judgement) -> list[dict[str, Any]]:
    """Return name, unit, meaning and frozen threshold of every signal and of our probabilities."""
    specs = {c["name"]: c for c in load_spec("signals")["columns"] if c.get("signal")}
    features = {c["name"]: c for c in load_spec("delayed")["columns"]}
    table, titles, found = judgement.metrics, names_of_signals(), []
    for name, threshold in zip(table["signal"], table["threshold"], strict=True):
        spec = specs.get(str(name), {"about": titles[str(name)]})
        found.append(
            {
                "name": str(name),
                "unit": spec.get("unit", "1"),
                "about": spec.get("about", ""),
                "threshold": None if np.isnan(threshold) else float(threshold),
            }
        )
    return found + [
        {
            "name": name,
            "unit": "1",
            "about": features[name]["about"],
            "threshold": None,
            "feature": True,
        }
        for name in judgement.calibration.final.reads
    ]


def route_json(
    judgement: Judgement, index: Int[np.ndarray, "t k"], similarity: Float[np.ndarray, "t k"]
) -> str:
    """Return what the page's script reads, as JSON that may stand inside HTML.

    Args:
        judgement: of the run.
        index: sealed map rows per frame, best first, -1 = no candidate.
        similarity: sealed similarities.

    Returns:
        Numbers as base64 of little-endian arrays, positions in metres from `origin`.
    """
    signals = _signals(judgement)
    names = [signal["name"] for signal in signals]
    every = -(-len(judgement.label) // MOST_FRAMES)
    shown = slice(None, None, every)
    origin = np.floor(judgement.map_m.min(axis=0))
    verdicts = judgement.verdicts
    columns = judgement.signals | {name: verdicts[name] for name in (NOW, FINAL)}
    columns[FUSED] = verdicts["probability_map_out"]
    columns |= judgement.delayed
    columns |= {name: probability(own, columns) for name, own in judgement.logistic.items()}
    pose = np.stack([verdicts["x_m"], verdicts["y_m"]], axis=1).astype(float)
    status, status_at = np.unique(judgement.signals["status"].astype(str), return_inverse=True)
    reason, reason_at = np.unique(
        judgement.verdicts["reason"][shown].astype(str), return_inverse=True
    )
    kinds = list(OUTCOMES)
    table = np.stack([np.asarray(columns[name], dtype=float)[shown] for name in names])
    held = {
        "frames": len(judgement.label),
        "every": every,
        "window": judgement.config.stream.window,
        "origin": origin.tolist(),
        "map": _floats(judgement.map_m - origin),
        "truth": _floats(judgement.query_m[shown] - origin),
        "pose": _floats(pose[shown] - origin),
        "nearest": _floats(judgement.nearest_m[shown]),
        "error": _floats(judgement.error_m[shown]),
        "verdict": _letters(
            judgement.verdicts["verdict"][shown], {"accept": "a", "reject": "r", "abstain": "-"}
        ),
        "label": _letters(judgement.label[shown], {"in_map": "i", "map_out": "o", "grey": "g"}),
        "split": _letters(
            judgement.splits.name[shown], {"calibration": "c", "gap": "g", "test": "t"}
        ),
        "kinds": [{"name": n, "label": m.label, "marker": m.marker} for n, m in OUTCOMES.items()],
        "kind": "".join(str(kinds.index(str(o))) for o in judgement.outcome[shown]),
        "statuses": status.tolist(),
        "status": "".join(str(at) for at in status_at[shown]),
        "reasons": reason.tolist(),
        "reason": reason_at.tolist(),
        "signals": signals,
        "values": _floats(table),
        "model": _model(judgement, names),
        "candidates": _candidates(index[shown], similarity[shown]),
    }
    # `<` could end the script element that holds this.
    return json.dumps(held, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
