"""A run as a recording of Rerun: map, answers, candidates and verdicts over frames and seconds.

All lies in the plane z = 0 of the map frame, metres. Colours are those of the figures.
"""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from taojax.errors import MissingExtraError
from taojax.files.atomic_write import locked_part
from taojax.files.pose_graph_io import Graph, Verdicts
from taojax.files.records import Run
from taojax.files.specs import fail

if TYPE_CHECKING:
    import rerun as rr

__all__ = ["Judged", "check_extra", "write_view"]

INSTALL = "python -m pip install 'taojax[view]'"

FRAME, SECONDS = "frame", "seconds"
"""Timelines: the number of the frame from 0, and seconds since the first one."""

VERDICT_COLOURS = {"accept": (0, 114, 178), "reject": (204, 121, 167), "abstain": (85, 85, 85)}
"""Verdict -> red, green, blue."""

LABEL_COLOURS = {"in_map": (0, 158, 115), "map_out": (213, 94, 0), "grey": (143, 143, 143)}
"""Label of the judge -> red, green, blue."""

PALE, ORANGE, GREEN = (154, 154, 154), (230, 159, 0), (0, 158, 115)


class _Stage(NamedTuple):
    """Where everything is drawn."""

    recording: "rr.RecordingStream"
    times: "list[rr.TimeColumn]"
    """Of all frames, on both timelines."""

    radius_m: float
    """Of a map place."""


class Judged(NamedTuple):
    """What the judge knows; the robot never did."""

    label: Shaped[np.ndarray, " t"]
    """in_map, map_out or grey."""

    xy_m: Float[np.ndarray, "t 2"] | None
    """True positions in the map frame [m]; None where they are not at hand."""


def check_extra() -> None:
    """Check, before any work, that Rerun is there.

    Raises:
        MissingExtraError: it is not.
    """
    if importlib.util.find_spec("rerun") is None:
        raise MissingExtraError(f"view needs rerun-sdk; run: {INSTALL}")


def write_view(
    out: Path, run: Run, verdicts: Verdicts, graph: Graph, judged: Judged | None
) -> None:
    """Write a recording; it appears whole or not at all, and replaces an older one.

    Args:
        out: an .rrd file.
        run: sealed, of T frames.
        verdicts: of the same frames.
        graph: made of both; its query poses are the trajectory.
        judged: None where nobody judged.

    Raises:
        InputError: the file cannot be written.
        MissingExtraError: Rerun is not installed.
    """
    check_extra()
    import rerun as rr

    recording = rr.RecordingStream(
        "taojax", recording_id=run.manifest["seal"], send_properties=False
    )
    stage = _Stage(recording, _times(run), graph.spacing_m / 8)
    _send_map(stage, graph)
    for name, verdict, probability, pose in (
        ("final", verdicts.verdict, verdicts.probability, verdicts.pose),
        ("now", verdicts.verdict_now, verdicts.probability_now, verdicts.pose_now),
    ):
        colours = _colours(verdict, VERDICT_COLOURS)
        _send_points(stage, f"map/answers/{name}", pose[:, None, :2], colours[:, None], 2.0)
        scalars = rr.Scalars.columns(scalars=probability)
        recording.send_columns(f"probability_wrong/{name}", stage.times, scalars)
    reasons = [f"{v}: {why}" for v, why in zip(verdicts.verdict, verdicts.reason, strict=True)]
    recording.send_columns("verdict/final", stage.times, rr.TextLog.columns(text=reasons))
    _send_candidates(stage, run, graph)
    if judged is not None:
        _send_judged(stage, judged)
    try:
        with locked_part(out, is_folder=False) as part:
            recording.save(part, default_blueprint=_blueprint())
            recording.disconnect()
            part.replace(out)
    except OSError as error:
        what = f"cannot be written ({error.strerror})"
        raise fail(out, what, "choose another --out") from error


def _times(run: Run) -> "list[rr.TimeColumn]":
    import rerun as rr

    t_s = run.signals["t_s"]
    return [
        rr.TimeColumn(FRAME, sequence=run.signals["frame"].astype(np.int64)),
        rr.TimeColumn(SECONDS, duration=t_s - t_s[0]),
    ]


def _flat(xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([xy_m, np.zeros(len(xy_m))])


def _colours(
    words: Shaped[np.ndarray, " t"], colour_of: dict[str, tuple[int, int, int]]
) -> UInt8[np.ndarray, "t 3"]:
    return np.array([colour_of[word] for word in words], np.uint8)


def _send_map(stage: _Stage, graph: Graph) -> None:
    """Show what does not change: the map, and where accepted answers and odometry lead."""
    import rerun as rr

    radius = stage.radius_m
    stage.recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    places = rr.Points3D(_flat(graph.map_pose[:, :2]), colors=PALE, radii=radius)
    stage.recording.log("map/places", places, static=True)
    strips = np.split(_flat(graph.query_pose[:, :2]), np.flatnonzero(graph.is_start)[1:])
    way = rr.LineStrips3D(strips, colors=PALE, radii=radius / 4)
    stage.recording.log("map/trajectory", way, static=True)


def _send_points(
    stage: _Stage, name: str, xy_m: Float[np.ndarray, "t k 2"], colours: UInt8[np.ndarray, "t k _"],
    size: float,
) -> None:  # fmt: skip
    """Send the points of each frame, `size` map places large; NaN is none."""
    import rerun as rr

    there = np.isfinite(xy_m[..., 0])
    columns = rr.Points3D.columns(positions=_flat(xy_m[there]), colors=colours[there])
    stage.recording.send_columns(name, stage.times, columns.partition(there.sum(axis=1)))
    radii = rr.Points3D.from_fields(radii=size * stage.radius_m)
    stage.recording.log(name, radii, static=True)


def _send_candidates(stage: _Stage, run: Run, graph: Graph) -> None:
    """Send the retrieved places of each frame, the better the more opaque."""
    xy_m = np.where((run.index >= 0)[..., None], graph.map_pose[run.index, :2], np.nan)
    colours = np.empty((*run.index.shape, 4), np.uint8)
    colours[..., :3] = ORANGE
    colours[..., 3] = np.linspace(255, 40, run.index.shape[1]).astype(np.uint8)
    _send_points(stage, "map/candidates", xy_m, colours, 1.5)


def _send_judged(stage: _Stage, judged: Judged) -> None:
    """Send what only the judge knows, under names that say so."""
    import rerun as rr

    words = [f"truth: {label}" for label in judged.label]
    stage.recording.send_columns("truth/label", stage.times, rr.TextLog.columns(text=words))
    if judged.xy_m is None:
        return
    way = rr.LineStrips3D([_flat(judged.xy_m)], colors=GREEN, radii=stage.radius_m / 4)
    stage.recording.log("map/truth/trajectory", way, static=True)
    colours = _colours(judged.label, LABEL_COLOURS)
    _send_points(stage, "map/truth/label", judged.xy_m[:, None], colours[:, None], 2.0)


def _blueprint() -> "rr.blueprint.Blueprint":
    """Lay out the map above the probabilities; answers stay, candidates are those of one frame."""
    import rerun.blueprint as rrb

    so_far = [
        rrb.VisibleTimeRange(
            name,
            start=rrb.TimeRangeBoundary.infinite(),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        for name in (FRAME, SECONDS)
    ]
    stays = rrb.VisibleTimeRanges(so_far)
    the_map = rrb.Spatial3DView(
        origin="map",
        name="map",
        overrides={f"map/answers/{name}": stays for name in ("final", "now")},
    )
    doubts = rrb.TimeSeriesView(origin="probability_wrong", name="probability that it is wrong")
    words = rrb.TextLogView(origin="/", name="verdicts")
    return rrb.Blueprint(
        rrb.Vertical(the_map, rrb.Horizontal(doubts, words), row_shares=[2, 1]),
        rrb.TimePanel(timeline=FRAME),
    )
