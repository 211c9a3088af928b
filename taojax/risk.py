"""The probability that an answer is wrong, and the level up to which answers are accepted.

A linear model of the log odds of being wrong, over features that mean the same on every recording.
It is fitted on pooled recordings and ships with the package; a judge with truth refines it and sets
its level again. Each answer is judged from its own row: memory is in the features. The detector of
the paper's question, in the map or off it, has the same form.
"""

import tomllib
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.errors import InputError
from taojax.files.specs import column_names, read_text

LARGEST_LOG_ODDS = 30.0
"""Keeps probabilities inside (0, 1) in float64."""

LIST_RECALL = 0.75
"""Recall of retrieval lists without map descriptors, and of a run that does not say: neither blind
nor sure."""


class MapFacts(NamedTuple):
    """Which map a calibration was fitted on, told by what both sides can measure."""

    poses_sha256: str
    """Of map/poses.csv."""

    views_sha256: str
    """Of the map's descriptors; blank where the frontend gives lists."""

    spacing_m: float
    """Median distance between neighbours."""

    recall: float
    """Share of map images whose most similar other image lies nearby."""


class Detector(NamedTuple):
    """Everything that `probability` needs."""

    columns: tuple[str, ...]
    """Signals it reads."""

    mean: Float[np.ndarray, " f"]
    """Of each signal over the in-map calibration frames, over all where none is: what its term is
    measured from."""

    scale: Float[np.ndarray, " f"]
    weight: Float[np.ndarray, " f"]
    """Log odds per standardised signal."""

    bias: float
    threshold: float
    """Frames with a probability above it are rejected; NaN = nothing can be decided."""

    note: str
    """How it was fitted, in words."""


def probability(detector: Detector, signals: Mapping[str, np.ndarray]) -> Float[np.ndarray, " t"]:
    """Return the probability of being off the map, frame by frame; no frame sees another.

    Args:
        detector: fitted numbers.
        signals: column -> (t,).
    """
    return _probability(detector, signals)


def foreign_map(then: MapFacts | None, here: MapFacts | None) -> str | None:
    """Say so where numbers were fitted on another map than the one at hand.

    Args:
        then: the map they were fitted on; None = no site's.
        here: the map that they are about to judge; None = unknown.

    Returns:
        One sentence; None where the map is the same, or nobody knows.
    """
    if then is None or here is None or then[:2] == here[:2]:
        return None
    is_same = then.poses_sha256 == here.poses_sha256
    what = "other descriptors of this map" if is_same else "another map"
    told = lambda facts: f"spacing {facts.spacing_m:.3g} m and recall {facts.recall:.2f}"
    return (
        f"the calibration was fitted on {what} ({told(then)}; here {told(here)}): how many wrong"
        " answers its level accepts here is unknown until this place is audited"
    )


DOUBT_COUNTS = 3.0
"""How often the filter's doubt of a lone answer counts: about as often as the level of the pooled
model exceeds the promised share, so that one is accepted where the filter doubts it by at most
that share. At 1 twice as many answers that are accepted after a simulated kidnap are wrong."""

SCHEMA = 3
"""Of calibration.toml; files of 0.1.0 have none."""

DEFAULT, FIRST_LOOK = "default_calibration.toml", "first_look.toml"

SHIPPED = "the calibration that ships with taojax"
"""Where numbers come from that no site has refined."""


class Risk(NamedTuple):
    """The frozen numbers of one verdict."""

    columns: tuple[str, ...]
    """Features it reads."""

    mean: Float[np.ndarray, " f"]
    """Of each feature over the pooled recordings: what its term is measured from."""

    scale: Float[np.ndarray, " f"]
    weight: Float[np.ndarray, " f"]
    """Log odds per standardised feature."""

    bias: float
    max_wrongs: Float[np.ndarray, " l"]
    """Shares of the accepted answers that may be wrong, ascending: for each there is a level."""

    levels: Float[np.ndarray, " l"]
    """Answers whose probability of being wrong is at most this are accepted; NaN = none are."""

    max_wrong: float
    """The share that is asked for."""

    promise: str
    """What is promised, on what assumption, in words."""

    alone: str = ""
    """Column with the filter's doubt of answers that stand alone; causal answers have none."""

    @property
    def reads(self) -> tuple[str, ...]:
        """Return every column that a probability needs."""
        return (*self.columns, self.alone) if self.alone else self.columns

    @property
    def level(self) -> float:
        """Return the level of the largest share on file that is not above what is asked for."""
        fits = np.flatnonzero(self.max_wrongs <= self.max_wrong * (1.0 + 1e-9))
        return float(self.levels[fits[-1]]) if fits.size else float("nan")


class First(NamedTuple):
    """Trust in an answer before its past is asked; the package's own, no site changes it."""

    now: Detector
    """Its threshold is the probability of being wrong at which an answer counts half."""

    final: Detector


class Calibration(NamedTuple):
    """Everything that verdicts rest on."""

    now: Risk
    """Of causal answers."""

    final: Risk
    """Of answers a lag later."""

    map_out: Detector
    """Of being off the map, as in the paper's tables."""

    fitted_on: MapFacts | None = None
    """None where it is the shipped one."""


def at_most(risk: Risk, max_wrong: float) -> Risk:
    """Return the same numbers for another share of wrong answers among the accepted."""
    if max_wrong == risk.max_wrong:
        return risk
    other = risk._replace(max_wrong=max_wrong)
    if np.isnan(other.level):
        said = f"nothing is accepted: no level is on file for {max_wrong:.3g}"
    else:
        said = f"at most {max_wrong:.3g} of the accepted answers wrong; else as for "
        said += f"{risk.max_wrong:.3g}: {risk.promise}"
    return other._replace(promise=said)


def for_run(calibration: Calibration, max_wrong: float, lag: int) -> Calibration:
    """Return the numbers for another share of wrong answers, and for a run without hindsight.

    Args:
        calibration: frozen numbers.
        max_wrong: share of the accepted answers that may be wrong.
        lag: of the run; with 0 the final answers are the causal ones, and judged as such.

    Raises:
        InputError: something else than a calibration.
    """
    if not isinstance(calibration, Calibration):
        got = type(calibration).__name__
        raise InputError(f"calibration: expected what read_calibration returns, got {got}")
    now, final = at_most(calibration.now, max_wrong), at_most(calibration.final, max_wrong)
    if lag == 0:
        final = now._replace(columns=tuple(name.removeprefix("now_") for name in now.columns))
    return calibration._replace(now=now, final=final)


def terms(model: "Risk | Detector", features: Mapping[str, np.ndarray]) -> Float[np.ndarray, "t f"]:
    """Return what each feature adds to the log odds above those of the mean it is measured from."""
    table = np.stack([np.asarray(features[name], float) for name in model.columns], axis=1)
    return (table - model.mean[None]) / model.scale[None] * model.weight[None]


def _probability(
    model: "Risk | Detector", features: Mapping[str, np.ndarray]
) -> Float[np.ndarray, " t"]:
    # Summed by hand: a matrix product may round differently for other numbers of frames.
    odds = np.sum(terms(model, features), axis=1) + model.bias
    return 1.0 / (1.0 + np.exp(-np.clip(odds, -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)))


def probability_wrong(risk: Risk, features: Mapping[str, np.ndarray]) -> Float[np.ndarray, " t"]:
    """Return the probability that each answer is wrong; of a lone one at least its own doubt."""
    return np.maximum(_probability(risk, features), lone_doubt(risk, features))


def lone_doubt(risk: Risk, features: Mapping[str, np.ndarray]) -> Float[np.ndarray, " t"]:
    """Return the least probability of being wrong of answers that stand alone; 0 of others."""
    if not risk.alone:
        return np.zeros(len(features[risk.columns[0]]))
    return np.minimum(1.0, DOUBT_COUNTS * np.asarray(features[risk.alone], float))


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "/").replace('"', "'") + '"'


def _section(name: str, numbers: Risk | Detector) -> list[str]:
    """Return one table of the file; both kinds of numbers have the same first five fields."""
    lines = [f"[{name}]"]
    for field, value in numbers._asdict().items():
        if isinstance(value, str):
            text = _quoted(value)
        elif isinstance(value, tuple):
            text = "[" + ", ".join(_quoted(part) for part in value) + "]"
        elif isinstance(value, np.ndarray):
            text = "[" + ", ".join(repr(float(number)) for number in value) + "]"
        else:
            text = repr(float(value))
        lines.append(f"{field} = {text}")
    return [*lines, ""]


def first_to_toml(detectors: Mapping[str, Detector]) -> str:
    """Return the numbers of the first look, `now` and `final`, as text."""
    head = "# Written by `python -m benchmarks verdict --write`."
    both = (line for name, one in detectors.items() for line in _section(name, one))
    return "\n".join([head, "", *both]).rstrip("\n") + "\n"


def to_toml(calibration: Calibration) -> str:
    """Return a calibration as text that `read_calibration` reads back unchanged."""
    lines = [
        "# Written by taojax; read by `taojax score --calibration FILE`.",
        f"schema = {SCHEMA}",
        "",
        *_section("now", calibration.now),
        *_section("final", calibration.final),
        *_section("map_out", calibration.map_out),
    ]
    if (facts := calibration.fitted_on) is not None:
        lines += [
            "[map]",
            f'poses_sha256 = "{facts.poses_sha256}"',
            f'views_sha256 = "{facts.views_sha256}"',
            f"spacing_m = {float(facts.spacing_m)!r}",
            f"recall = {float(facts.recall)!r}",
        ]
    return "\n".join(lines).rstrip("\n") + "\n"


def _model(
    tree: Mapping[str, Any], spec: str
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray, float]:
    """Return columns, mean, scale, weight and bias of one table, checked."""
    columns = tuple(str(name) for name in tree["columns"])
    vectors = [np.array(tree[name], float) for name in ("mean", "scale", "weight")]
    unknown = sorted(set(columns) - set(column_names(spec)))
    if unknown:
        raise ValueError(f"unknown column {unknown[0]!r}")
    bias = float(tree["bias"])
    numbers = np.concatenate([*(vector.ravel() for vector in vectors), [bias]])
    fits = all(vector.shape == (len(columns),) for vector in vectors)
    if not fits or not np.isfinite(numbers).all() or not (vectors[1] > 0).all():
        raise ValueError("mean, scale and weight do not fit the columns")
    return columns, vectors[0], vectors[1], vectors[2], bias


def _detector(tree: Mapping[str, Any], spec: str) -> Detector:
    return Detector(*_model(tree, spec), float(tree["threshold"]), str(tree["note"]))


def _risk(tree: Mapping[str, Any], spec: str) -> Risk:
    model = _model(tree, spec)
    shares, levels = np.array(tree["max_wrongs"], float), np.array(tree["levels"], float)
    most = float(tree["max_wrong"])
    is_level = np.isnan(levels) | ((levels >= 0.0) & (levels <= 1.0))
    if shares.ndim != 1 or shares.shape != levels.shape or not is_level.all() or not 0 < most < 1:
        raise ValueError("max_wrongs, levels and max_wrong do not fit")
    alone = str(tree.get("alone", ""))
    if alone and alone not in column_names(spec):
        raise ValueError(f"unknown column {alone!r}")
    return Risk(*model, shares, levels, most, str(tree["promise"]), alone)


def _parse(text: str, where: str) -> Calibration:
    fix = "use the calibration.toml of a run made by `taojax audit`"
    try:
        tree = tomllib.loads(text)
        if "schema" not in tree and "threshold" in tree:
            raise InputError(
                f"{where}: is a calibration of taojax 0.1.0, which did not tell right from wrong; "
                "audit the recording again with `taojax audit`"
            )
        if tree["schema"] != SCHEMA:
            raise ValueError(f"schema {tree['schema']}, this taojax reads {SCHEMA}")
        facts = None
        if (seen := tree.get("map")) is not None:
            facts = MapFacts(
                str(seen["poses_sha256"]), str(seen["views_sha256"]),
                float(seen["spacing_m"]), float(seen["recall"]),
            )  # fmt: skip
        now, final = _risk(tree["now"], "signals"), _risk(tree["final"], "delayed")
        map_out = _detector(tree["map_out"], "delayed")
    except (KeyError, TypeError, ValueError, RecursionError, OverflowError) as error:
        raise InputError(f"{where}: is not a calibration file ({error}); {fix}") from error
    return Calibration(now, final, map_out, facts)


def read_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    Args:
        path: calibration.toml of an audited run, or detector.toml of a scored one.

    Raises:
        InputError: unreadable, made by taojax 0.1.0, or its numbers do not fit together.
    """
    return _parse(read_text(Path(path)), str(path))


@lru_cache(maxsize=1)
def shipped() -> Calibration:
    """Return the calibration that ships with the package, fitted on pooled recordings."""
    text = resources.files("taojax").joinpath(DEFAULT).read_text(encoding="utf-8")
    return _parse(text, DEFAULT)


@lru_cache(maxsize=1)
def first_look() -> First:
    """Return the first look that ships with the package, fitted on pooled recordings."""
    text = resources.files("taojax").joinpath(FIRST_LOOK).read_text(encoding="utf-8")
    tree = tomllib.loads(text)
    return First(*(
        _detector(tree[kind], spec)
        for kind, spec in (("now", "signals"), ("final", "delayed"))
    ))  # fmt: skip
