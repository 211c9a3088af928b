"""Loop closures as files that other tools read: g2o for pose graphs, TUM for trajectories.

Ids of the graph: map row m is vertex m, query frame t is vertex M + t; of one drive that closes on
itself frame t is vertex t. Every edge is an EDGE_SE2:
the pose of the second vertex in axes of the first, then the upper triangle of its information
matrix. There are no comments and no FIX lines, which some readers refuse.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from taojax.config import StreamConfig, from_toml
from taojax.decisions import decide
from taojax.errors import InputError
from taojax.files.records import Run
from taojax.files.specs import fail, read_text
from taojax.files.tables import MOTION, POSE, read_frames, read_table, stacked, table_text
from taojax.risk import Calibration, for_run, read_calibration

__all__ = [
    "Graph",
    "Verdicts",
    "as_verdicts",
    "at_share",
    "between",
    "build_graph",
    "closure_text",
    "compose",
    "g2o_text",
    "in_axes_of",
    "read_verdicts",
    "tum_text",
    "wrap",
]

MAP_STIFFNESS = 1000.0
"""Edges between neighbouring map poses are so many times tighter than a closure: the map stays."""

ODOMETRY_SHARE = 0.1
"""Standard deviation of an odometry edge, of the distance driven."""

LEAST_SPACINGS = 0.01
"""It is never less than so much of the map's spacing."""

ODOMETRY_RAD = 0.02
"""Standard deviation of its turn [rad]."""


class Verdicts(NamedTuple):
    """What was decided of every frame of a run."""

    source: str
    """The file that says so."""

    verdict: Shaped[np.ndarray, " t"]
    """accept, reject or abstain, finally."""

    probability: Float[np.ndarray, " t"]
    """That the final answer is wrong."""

    reason: Shaped[np.ndarray, " t"]
    """In words."""

    pose: Float[np.ndarray, "t 3"]
    """The final answer: x [m], y [m], theta [rad]; NaN without one."""

    map_index: Int[np.ndarray, " t"]
    """Its map row, -1 without one."""

    verdict_now: Shaped[np.ndarray, " t"]
    probability_now: Float[np.ndarray, " t"]
    reason_now: Shaped[np.ndarray, " t"]
    pose_now: Float[np.ndarray, "t 3"]
    """The causal verdict and answer."""

    calibration: Calibration
    """The frozen numbers behind the verdicts."""


class Graph(NamedTuple):
    """Map, query frames and what ties them."""

    map_pose: Float[np.ndarray, "m 3"]
    """x [m], y [m], theta [rad]."""

    query_pose: Float[np.ndarray, "t 3"]
    """Accepted poses, and between them what odometry makes of the last one."""

    t_s: Float[np.ndarray, " t"]
    odometry: Float[np.ndarray, "t 3"]
    is_start: Bool[np.ndarray, " t"]
    """No odometry edge leads into this frame."""

    pose: Float[np.ndarray, "t 3"]
    """Answered pose of every frame; NaN without one."""

    map_index: Int[np.ndarray, " t"]
    verdict: Shaped[np.ndarray, " t"]
    covariance: Float[np.ndarray, "t 3 3"]
    """Of the answered pose: x [m], y [m], theta [rad] in the map frame."""

    sigma_m: float
    """Standard deviation of a position where nothing better is known: the Huber threshold."""

    sigma_rad: float
    """Of an angle: the Huber threshold over the length of a window."""

    spacing_m: float
    is_own: bool = False
    """Map row m is query frame m: one drive that closes on itself."""

    def rows(self, verdict: str) -> Int[np.ndarray, " c"]:
        """Return the frames with one verdict and a pose."""
        return np.flatnonzero((self.verdict == verdict) & (self.map_index >= 0))


def refuse_foreign(folder: Path, run: Run) -> None:
    """Check that a judge's folder speaks of this run and no other.

    Raises:
        InputError: its audit.json is missing or malformed, or names another seal.
    """
    try:
        seal = json.loads(read_text(folder / "audit.json"))["run_seal"]
    except (ValueError, KeyError, TypeError) as error:
        what = "does not say which run was judged"
        raise fail(folder / "audit.json", what, "judge the run again") from error
    if seal != run.manifest["seal"]:
        fix = "judge this one again with `taojax evaluate`"
        raise fail(folder / "verdicts.csv", "speaks of another run", fix)


def read_verdicts(folder: Path, run: Run) -> Verdicts | None:
    """Read what was decided: by the judge, who knows this place, else sealed at run time.

    Args:
        folder: the run.
        run: read from it by `read_run`.

    Returns:
        None where nobody decided.

    Raises:
        InputError: a file is malformed, or speaks of another run.
    """
    path, numbers = folder / "verdicts.csv", folder / "calibration.toml"
    if path.is_file():
        refuse_foreign(folder, run)
        table = read_frames(path, "verdicts", len(run.signals["frame"]))
    elif run.decisions is not None:
        path, numbers, table = folder / "decisions.csv", folder / "detector.toml", run.decisions
    else:
        return None
    return as_verdicts(path.name, table, read_calibration(numbers))


def as_verdicts(source: str, table: Mapping[str, np.ndarray], numbers: Calibration) -> Verdicts:
    """Return verdicts from the columns of verdicts.csv.

    Args:
        source: the file that says so.
        table: its columns.
        numbers: the frozen ones behind them.
    """
    return Verdicts(
        source,
        table["verdict"],
        table["probability_wrong"],
        table["reason"],
        stacked(table, POSE),
        table["map_index"].astype(int),
        table["verdict_now"],
        table["probability_wrong_now"],
        table["reason_now"],
        stacked(table, ("x_now_m", "y_now_m", "theta_now_rad")),
        numbers,
    )


def at_share(
    folder: Path, run: Run, verdicts: Verdicts, max_wrong: float | None, lag: int | None
) -> Verdicts:
    """Decide again by the same numbers, for another share of wrong answers.

    Args:
        folder: the run.
        run: read from it.
        verdicts: what was decided there.
        max_wrong: share of the accepted answers that may be wrong, in (0, 1); None = as it was.
        lag: that the run must have been scored with; None = any.

    Raises:
        InputError: the run was scored with another lag.
    """
    own = from_toml(folder / "config.toml").verdict.lag
    if lag is not None and lag != own:
        fix = f"score the data again with --lag {lag}"
        raise fail(folder / "config.toml", f"its final verdicts wait {own} frames", fix)
    if max_wrong is None:
        return verdicts
    numbers = for_run(verdicts.calibration, max_wrong, own)
    table = decide(numbers, run.signals, run.delayed)
    return as_verdicts(verdicts.source, table, numbers)


def wrap(angle: np.ndarray | float) -> np.ndarray:
    """Return angles in (-pi, pi] [rad]."""
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return pose `b`, given in axes of `a`, in the frame of `a`.

    Args:
        a: (..., 3) x [m], y [m], theta [rad], float64.
        b: likewise.
    """
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = b[..., 0], b[..., 1]
    theta = wrap(a[..., 2] + b[..., 2])
    return np.stack([a[..., 0] + c * x - s * y, a[..., 1] + s * x + c * y, theta], axis=-1)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return pose `b` in axes of `a`; both (..., 3) x [m], y [m], theta [rad]."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * x + s * y, c * y - s * x, wrap(b[..., 2] - a[..., 2])], axis=-1)


def inverse(pose: np.ndarray) -> np.ndarray:
    """Return the pose that undoes another; (..., 3) x [m], y [m], theta [rad]."""
    return between(pose, np.zeros(3))


def _chained(odometry: np.ndarray, known: np.ndarray, is_start: np.ndarray) -> np.ndarray:
    """Return a pose for every frame: the known ones, and odometry from the last of them.

    Frames before the first known pose are found backwards from it; a stretch without any starts at
    the origin.
    """
    out = np.zeros_like(known)
    has = np.isfinite(known[:, 0])
    starts = np.flatnonzero(is_start)
    for first, end in zip(starts, [*starts[1:], len(known)], strict=True):
        inside = first + np.flatnonzero(has[first:end])
        anchor = int(inside[0]) if inside.size else int(first)
        out[anchor] = known[anchor] if inside.size else 0.0
        for t in range(anchor, first, -1):
            still = between(odometry[t], np.zeros(3))
            out[t - 1] = compose(out[t], still)
        for t in range(anchor + 1, end):
            out[t] = known[t] if has[t] else compose(out[t - 1], odometry[t])
    return out


def build_graph(folder: Path, run: Run, verdicts: Verdicts) -> Graph:
    """Put together what the files say.

    Args:
        folder: the run.
        run: read from it by `read_run`.
        verdicts: from `read_verdicts`.

    Raises:
        InputError: the run was sealed without its odometry.
    """
    facts = run.manifest
    if "odometry.csv" not in facts["sha256"] or "map_spacing_m" not in facts:
        what = "lacks odometry.csv or map_spacing_m, sealed by newer versions"
        raise InputError(f"{folder}: {what}; score the data set again with `taojax score`")
    table = read_table(folder / "odometry.csv", "query_odometry")
    odometry = stacked(table, MOTION)
    poses, pose = run.map_poses, verdicts.pose
    is_accepted = (verdicts.verdict == "accept") & np.isfinite(pose[:, 0])
    n = len(odometry)
    is_start = np.arange(n) % (facts.get("trial_frames") or n) == 0
    settings: StreamConfig = from_toml(folder / "config.toml").stream
    spacing_m = float(facts["map_spacing_m"])
    delta = float(settings.delta_spacings)
    sigma_m, sigma_rad = delta * spacing_m, delta / settings.window
    covariance = np.zeros((n, 3, 3))
    for name, row, column in (("var_x_m2", 0, 0), ("var_y_m2", 1, 1), ("cov_xy_m2", 0, 1)):
        covariance[:, row, column] = covariance[:, column, row] = run.delayed[name]
    covariance[:, 2, 2] = sigma_rad**2
    return Graph(
        map_pose=stacked(poses, POSE),
        query_pose=_chained(odometry, np.where(is_accepted[:, None], pose, np.nan), is_start),
        t_s=table["t_s"],
        odometry=odometry,
        is_start=is_start,
        pose=pose,
        map_index=verdicts.map_index,
        verdict=verdicts.verdict,
        covariance=covariance,
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
        spacing_m=spacing_m,
        is_own="own_gap_m" in facts,
    )


def _lines(tag: str, *columns: np.ndarray) -> list[str]:
    rows = np.column_stack([np.asarray(column, dtype=object) for column in columns])
    return [
        " ".join([tag, *(str(v) if isinstance(v, int) else f"{v:.9g}" for v in row)])
        for row in rows.tolist()
    ]


def _edges(a: np.ndarray, b: np.ndarray, motion: np.ndarray, covariance: np.ndarray) -> list[str]:
    information = np.linalg.inv(covariance)
    upper = information[:, *np.triu_indices(3)]
    return _lines("EDGE_SE2", a, b, motion, upper)


def _diagonal(n: int, sigma_m: np.ndarray | float, sigma_rad: float) -> np.ndarray:
    """Return n covariances (n, 3, 3) of one angle and of one or n positions."""
    out = np.zeros((n, 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.broadcast_to(sigma_m, n) ** 2
    out[:, 2, 2] = sigma_rad**2
    return out


def in_axes_of(
    pose: Float[np.ndarray, "*b 3"], covariance: Float[np.ndarray, "*b 3 3"]
) -> Float[np.ndarray, "*b 3 3"]:
    """Turn covariances of x, y, theta from the map frame into the axes of their own poses.

    g2o and GTSAM measure the error of an edge there.
    """
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    turn = np.zeros((*pose.shape, 3))
    turn[..., 0, 0], turn[..., 0, 1], turn[..., 1, 0], turn[..., 1, 1] = c, s, -s, c
    turn[..., 2, 2] = 1.0
    return turn @ covariance @ np.swapaxes(turn, -1, -2)


def g2o_text(graph: Graph, verdict: str) -> str:
    """Return a pose graph: map, query frames, odometry, and the closures with one verdict.

    Args:
        graph: from `build_graph`.
        verdict: accept, or reject for a graph to compare with; never optimise that one.

    Returns:
        A g2o file; one drive that closes on itself has its frames alone for vertices, where its
        odometry has put them. The information matrix of a closure is the inverse of the covariance
        that it carries, turned into the axes of its pose; the map's own edges are `MAP_STIFFNESS`
        times tighter than the Huber threshold (3 map spacings) in standard deviation; an odometry
        edge takes 10 % of its length, at least 1 % of the spacing, and `ODOMETRY_RAD`. Put your
        own covariance there if you have one.
    """
    n_map, n_query = len(graph.map_pose), len(graph.query_pose)
    rows, after = graph.rows(verdict), np.flatnonzero(~graph.is_start)
    driven = np.hypot(graph.odometry[after, 0], graph.odometry[after, 1])
    slack = np.maximum(ODOMETRY_SHARE * driven, LEAST_SPACINGS * graph.spacing_m)
    m, place = np.arange(n_map), graph.map_index[rows]
    lines = _lines("VERTEX_SE2", m, graph.map_pose)
    if graph.is_own:
        n_map = 0
    else:
        stiff = graph.sigma_m / MAP_STIFFNESS, graph.sigma_rad / MAP_STIFFNESS
        along = between(graph.map_pose[:-1], graph.map_pose[1:])
        lines += _lines("VERTEX_SE2", n_map + np.arange(n_query), graph.query_pose)
        lines += _edges(m[:-1], m[1:], along, _diagonal(n_map - 1, *stiff))
    lines += [
        *_edges(
            n_map + after - 1, n_map + after, graph.odometry[after],
            _diagonal(len(after), slack, ODOMETRY_RAD),
        ),
        *_edges(
            place, n_map + rows, between(graph.map_pose[place], graph.pose[rows]),
            in_axes_of(graph.pose[rows], graph.covariance[rows]),
        ),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def closure_text(graph: Graph, run: Run, verdicts: Verdicts) -> str:
    """Return the accepted closures as a table, each with both time stamps and its covariance."""
    rows = graph.rows("accept")
    # Row m of the map of one drive that closes on itself is frame m.
    map_t_s = graph.t_s if graph.is_own else run.map_poses["t_s"]
    covariance = graph.covariance[rows]
    table = {
        "frame": rows,
        "t_s": graph.t_s[rows],
        "map_index": graph.map_index[rows],
        "map_t_s": map_t_s[graph.map_index[rows]],
        **dict(zip(POSE, graph.pose[rows].T, strict=True)),
        "probability_wrong": verdicts.probability[rows],
        "var_x_m2": covariance[:, 0, 0],
        "var_y_m2": covariance[:, 1, 1],
        "cov_xy_m2": covariance[:, 0, 1],
        "var_theta_rad2": covariance[:, 2, 2],
    }
    return table_text("closure_list", table)


def tum_text(graph: Graph) -> str:
    """Return the accepted poses as a TUM trajectory: `t x y z qx qy qz qw`, one line each.

    Of frames with one stamp the first is kept, because readers want stamps to rise.
    """
    rows = graph.rows("accept")
    rows = rows[np.diff(graph.t_s[rows], prepend=-np.inf) > 0]
    half = 0.5 * graph.pose[rows, 2]
    zero = np.zeros(len(rows))
    columns = (*graph.pose[rows, :2].T, zero, zero, zero, np.sin(half), np.cos(half))
    return "".join(
        " ".join([repr(float(t)), *(f"{v:.9g}" for v in row)]) + "\n"
        for t, row in zip(graph.t_s[rows], np.stack(columns, axis=1), strict=True)
    )
