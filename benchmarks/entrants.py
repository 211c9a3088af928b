"""Who competes: our signals, every rival on the same frames, two oracles that know the truth."""

import time
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.sets import DataSet
from taojax.audit import calibration, labels, risk, sequential
from taojax.baselines.models import Frames
from taojax.config import Config
from taojax.risk import for_run, probability_wrong, shipped
from taojax.risk import probability as probability_map_out
from taojax.runtime import hindsight
from taojax.runtime.frames import Frame, StreamRecord
from taojax.runtime.maps import LEAST_RANGE, MapTables, map_tables
from taojax.runtime.rivals import SYSTEMS
from taojax.runtime.score import replay_log
from taojax.runtime.stream import answered

OURS = ("tao", "tao_rank")
"""Columns of our stream that compete."""

FUSED = "probability_map_out"

GATES = ("top1", "top1_w5", "top1_w10", "top1_w20", "margin", "entropy", "velocity", "sue")
"""Columns that judge the frontend's answer and have no place of their own."""

UNCOMPILED = ("particles", "particles, injection", "mht", "sue, authors' constant")
"""NumPy: the first run is as fast as the second."""

SLOW = ("trajectory prior",)
"""Left out of a quick run."""

FITTED = (FUSED, "verdict, now", "verdict, final", "sticky similarity", "sequential test")
"""Learn from the calibration half, so that only their test half counts."""

ORACLES = ("oracle alignment", "oracle levels")

N_BINS = 20
"""Of the similarity histogram that the oracle of levels knows."""


class Entry(NamedTuple):
    """What one entrant says of every frame of a set."""

    name: str
    kind: str
    """ours, rival or oracle."""

    signal: np.ndarray
    """(T,) larger = more likely off the map, probabilities as log odds; NaN where nothing could be
    fitted."""

    place_m: np.ndarray | None = None
    """(T, 2) believed position [m], NaN without one."""

    us_per_frame: float = float("nan")


class Field(NamedTuple):
    """The labels of a set: what the judge knows."""

    label: np.ndarray
    nearest_m: np.ndarray
    """(T,) distance of the truth from the nearest map pose [m]."""

    share: float
    gap: int

    def split(self, signals: dict[str, np.ndarray]) -> labels.Splits:
        """Cut signals into calibration and test."""
        return labels.split_frames(
            signals, self.label, calibration_share=self.share, gap_frames=self.gap
        )


def field_of(data: DataSet, config: Config) -> Field:
    """Label the frames of a set and fix its split."""
    nearest = labels.nearest_map_distance(data.truth_m, data.map_poses[:, :2])
    label = labels.label_frames(nearest, data.r_in_m, data.r_out_m)
    return Field(label, nearest, config.audit.calibration_share, config.stream.window)


def log_odds(probability: np.ndarray) -> np.ndarray:
    """Return log odds: mean and deviation of a probability mean little, and ranks stay."""
    inside = np.clip(probability, 1e-15, 1.0 - 1e-15)
    return np.log(inside) - np.log1p(-inside)


def _timed(function: Callable[[], object], n_frames: int) -> float:
    start = time.perf_counter()
    function()
    return (time.perf_counter() - start) / n_frames * 1e6


class Played(NamedTuple):
    """A set, replayed."""

    records: StreamRecord
    tables: MapTables
    both: hindsight.Both
    us: float
    """Per frame of the literal stream, without compilation."""

    both_us: float
    """Per frame of the answers, now and finally."""


def stream(data: DataSet, config: Config) -> Played:
    """Replay a set."""
    tables = map_tables(data.map_poses, None, data.map_descriptors)
    frames = Frame(*(jnp.asarray(a) for a in (data.odometry, data.index, data.similarity)))
    records = replay_log(config, tables, frames)
    some = jax.tree.map(lambda leaf: leaf[:256], frames)
    us = _timed(lambda: replay_log(config, tables, some), len(some.odometry))
    seen = hindsight.clean(tables, data.odometry, data.index, data.similarity)
    both = hindsight.replay_both(config.verdict, tables, seen)
    both_us = _timed(lambda: hindsight.replay_both(config.verdict, tables, seen), len(data.index))
    return Played(answered(config, records, both.now), tables, both, us, both_us)


def rivals(data: DataSet, wanted: Callable[[str], bool]) -> list[Entry]:
    """Run the systems on the same frames as ours."""
    frames = Frames(
        data.map_poses, data.odometry.astype(float), data.rows, data.index, data.similarity
    )
    found = []
    for name, system in SYSTEMS.items():
        if not wanted(name):
            continue
        tracks = []
        us = _timed(lambda run=system, to=tracks: to.append(run(frames)), len(data.odometry))
        if name not in UNCOMPILED:
            us = _timed(lambda run=system: run(frames), len(data.odometry))
        track = tracks[0]
        place = np.where(track.map_index[:, None] >= 0, track.pose[:, :2].astype(float), np.nan)
        found.append(Entry(name, "rival", track.signal.astype(float), place, us))
    return found


def similarity_filters(top1: np.ndarray, field: Field, place: np.ndarray) -> list[Entry]:
    """Fit the sticky filter and the sequential test of the top-1 signal on the calibration half."""
    known = field.split({"top1": top1}).calibration
    chosen = known.is_in | known.is_out
    slope, bias = sequential.fit_log_likelihood_ratio(
        known.signals["top1"][chosen], known.is_out[chosen]
    )
    ratio = slope * top1 + bias
    us = _timed(lambda: sequential.sticky_filter(ratio), len(top1))
    sticky = log_odds(sequential.sticky_filter(ratio))
    found = [Entry("sticky similarity", "rival", sticky, place, us)]
    us = _timed(lambda: sequential.sequential_test(ratio), len(top1))
    test = sequential.sequential_test(ratio).signal
    return [*found, Entry("sequential test", "rival", test, place, us)]


def oracle_alignment(data: DataSet, config: Config, tables: MapTables) -> np.ndarray:
    """Return the cost along the true path, whatever the filter believed.

    In every frame the best anchor about the true place is taken: truncated Huber cost of its
    distance plus 1 - similarity on the fixed scale, averaged over the window of the paper.
    """
    n_map = len(data.map_poses)
    low, high = np.asarray(tables.scale, float)
    scaled = np.clip((data.similarity - low) / max(high - low, LEAST_RANGE), 0.0, 1.0)
    rows = np.zeros((len(data.index), n_map + 1))
    # Number -1, no candidate, is the spare column; anchors that no list names count as background.
    np.put_along_axis(rows, np.where(data.index >= 0, data.index, n_map), scaled, axis=1)
    tolerance = float(config.verdict.near_gaps * tables.places.gap_m)
    gap = data.seen_m[:, None] - data.map_poses[None, :, :2]
    r = np.hypot(gap[..., 0], gap[..., 1]) / tolerance
    residual = np.where(r <= 1.0, 0.5 * r**2, r - 0.5)
    cost = np.minimum(1.0, 0.5 * (residual + 1.0 - rows[:, :n_map]).min(axis=1))
    total, at = np.cumsum(np.append(0.0, cost)), np.arange(len(cost))
    first = np.maximum(at + 1 - config.stream.window, 0)
    return (total[at + 1] - total[first]) / (at + 1 - first)


def oracle_levels(top1: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return the log odds of a sticky filter that knows both classes' similarity histograms."""
    known = label != "grey"
    edges = np.quantile(top1[known], np.linspace(0.0, 1.0, N_BINS + 1)[1:-1])
    place = np.searchsorted(edges, top1)

    def log_share(chosen: np.ndarray) -> np.ndarray:
        count = np.bincount(place[chosen], minlength=N_BINS) + 0.5
        return np.log(count / count.sum())

    ratio = log_share(label == "map_out") - log_share(label == "in_map")
    return log_odds(sequential.sticky_filter(ratio[place]))


def _ours(field: Field, run: Played) -> list[Entry]:
    """Read our columns and fit the probability of being off the map on the calibration half."""
    records = run.records
    columns = {name: np.asarray(values, float) for name, values in records.signals.items()}
    place = np.where(records.has_pose[:, None], records.pose[:, :2].astype(float), np.nan)
    found = [
        Entry(name, "ours", columns[name], None if name == "tao_rank" else place, run.us)
        for name in OURS
    ]
    delayed = hindsight.delayed_columns(run.both.final)
    base = shipped().map_out
    features = {name: delayed[name] for name in base.columns}
    model = calibration.fit(field.split(features).calibration, base)
    believed = run.both.final.pose[:, :2].astype(float)
    probability = log_odds(probability_map_out(model, delayed))
    return [*found, Entry(FUSED, "ours", probability, believed, run.both_us)]


def _verdicts(
    data: DataSet, field: Field, config: Config, run: Played
) -> tuple[list[Entry], Entry]:
    """Answer now and a lag later, the risk refined on the calibration half; and a two-sided rival.

    Returns:
        Our two entries, and the mean of top-1 over as many frames on both sides.
    """
    both, audit = run.both, config.audit
    found = []
    for kind, answer, columns in (
        ("now", both.now, hindsight.now_columns(both.now)),
        ("final", both.final, hindsight.delayed_columns(both.final)),
    ):
        base = getattr(for_run(shipped(), audit.max_wrong, config.verdict.lag), kind)
        place = answer.pose[:, :2].astype(float)
        error = np.hypot(*(place - data.truth_m).T)
        half = field.split({name: columns[name] for name in base.reads}).calibration
        own = risk.own_answers(error, field.nearest_m, audit.wrong_m, audit.r_out_m)
        cut = risk.Own(own.is_right[half.frame], own.is_wrong[half.frame])
        p = probability_wrong(risk.refine(base, half, cut, audit.max_wrong), columns)
        found.append(Entry(f"verdict, {kind}", "ours", log_odds(p), place, run.both_us))
    top1 = 1.0 - np.where(data.index[:, 0] >= 0, data.similarity[:, 0], 0.0).astype(float)
    lag, total = config.verdict.lag, np.cumsum(np.append(0.0, top1))
    low = np.maximum(np.arange(len(top1)) - lag, 0)
    high = np.minimum(np.arange(len(top1)) + lag + 1, len(top1))
    two_sided = (total[high] - total[low]) / (high - low)
    top = data.index[:, 0]
    place = np.where(top[:, None] >= 0, data.map_poses[np.maximum(top, 0), :2], np.nan)
    return found, Entry("top1, two-sided", "rival", two_sided, place)


def compete(
    data: DataSet, config: Config, *, quick: bool = False, names: Collection[str] | None = None
) -> tuple[Field, list[Entry]]:
    """Let everybody judge the same frames.

    Args:
        data: the set.
        config: ours; rivals keep their published defaults.
        quick: leave out the slow systems.
        names: only these entrants; all when omitted.

    Returns:
        The labels, and one entry per entrant: ours, rivals, oracles.
    """

    def wanted(name: str) -> bool:
        return not (quick and name in SLOW) if names is None else name in names

    field = field_of(data, config)
    run = stream(data, config)
    signals = run.records.signals
    top1 = np.asarray(signals["top1"], float)
    top = data.index[:, 0]
    answer = np.where(top[:, None] >= 0, data.map_poses[np.maximum(top, 0), :2], np.nan)
    gates = [Entry(name, "rival", np.asarray(signals[name], float), answer) for name in GATES]
    audit = replace(config.audit, r_in_m=data.r_in_m, r_out_m=data.r_out_m)
    verdicts, two_sided = _verdicts(data, field, replace(config, audit=audit), run)
    entries = [
        *_ours(field, run),
        *verdicts,
        *gates,
        two_sided,
        *similarity_filters(top1, field, answer),
        *rivals(data, wanted),
        Entry(ORACLES[0], "oracle", oracle_alignment(data, config, run.tables)),
        Entry(ORACLES[1], "oracle", oracle_levels(top1, field.label)),
    ]
    return field, [entry for entry in entries if wanted(entry.name)]
