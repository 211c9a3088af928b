"""What the rivals say of the same frames, to be sealed beside our signals."""

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from tqdm import tqdm

from taojax.baselines.filters import topological, virtual_place
from taojax.baselines.mht import mht
from taojax.baselines.models import Frames
from taojax.baselines.particles import ParticleParams, particles
from taojax.baselines.sequence import seqslam, sue
from taojax.baselines.topometric import TopometricParams, topometric
from taojax.baselines.trajectory_prior import trajectory_prior
from taojax.files.records import SealedTrack
from taojax.runtime.frames import Frame, StreamRecord
from taojax.runtime.observations import Observations
from taojax.runtime.retrieval import dense


class Said(Protocol):
    """What every rival returns: a `Track`, or one with more to tell."""

    @property
    def signal(self) -> np.ndarray: ...  # noqa: D102
    @property
    def map_index(self) -> np.ndarray: ...  # noqa: D102
    @property
    def pose(self) -> np.ndarray: ...  # noqa: D102


SYSTEMS: Mapping[str, Callable[[Frames], Said]] = {
    "topometric": topometric,
    "topometric, both directions": lambda f: topometric(f, TopometricParams(both_directions=True)),
    "topological": topological,
    "virtual place": virtual_place,
    "particles": particles,
    "particles, injection": lambda f: particles(f, ParticleParams(injection=True)),
    "mht": mht,
    "seqslam": seqslam,
    "sue, authors' constant": sue,
    "trajectory prior": trajectory_prior,
}
"""Rivals that are systems of their own, with published defaults."""


def sealed_track(records: StreamRecord, signal: str) -> SealedTrack:
    """Return one of our own signals with the poses of its best branch."""
    return SealedTrack(
        np.asarray(records.signals[signal]), np.asarray(records.pose), np.asarray(records.has_pose)
    )


def dense_lists(index: np.ndarray, similarity: np.ndarray, n_map: int) -> np.ndarray:
    """Return `(T, M)` float32 similarity to every map row; 0 where a `(T, K)` list names none."""
    rows = np.zeros((len(index), n_map + 1), np.float32)
    rows[np.arange(len(index))[:, None], index] = similarity  # -1 writes into the spare column
    return rows[:, :-1]


def _dense(observations: Observations, frames: Frame, chosen: slice) -> np.ndarray:
    """Return the similarity of some frames to every map row."""
    if observations.descriptors is not None:
        return dense(observations.descriptors[0], observations.descriptors[1][chosen])
    index, similarity = np.asarray(frames.index)[chosen], np.asarray(frames.similarity)[chosen]
    return dense_lists(index, similarity, len(observations.map_poses["t_s"]))


def rival_tracks(
    observations: Observations,
    frames: Frame,
    *,
    most_logs: int,
    progress: bool = False,
) -> dict[str, SealedTrack]:
    """Run every rival on the same frames, each trial from a fresh start.

    Args:
        observations: of the data folder.
        frames: what our own stream was given, one leading time axis.
        most_logs: only so many trials, the first ones: rivals are slow.
        progress: draw a bar on stderr.

    Returns:
        Name -> track over all frames; NaN and no pose on trials that were left out.
    """
    n_frames = len(observations.t_s)
    length = observations.trial_frames or n_frames
    n_logs = min(n_frames // length, most_logs)
    tracks = {
        name: SealedTrack(
            np.full(n_frames, np.nan, np.float32),
            np.zeros((n_frames, 3), np.float32),
            np.zeros(n_frames, bool),
        )
        for name in (SYSTEMS if n_logs else ())
    }
    with tqdm(total=n_logs * len(SYSTEMS), unit="log", disable=not progress, leave=False) as bar:
        for log in range(n_logs):
            chosen = slice(log * length, (log + 1) * length)
            given = Frames(
                observations.map_xyt,
                np.asarray(frames.odometry)[chosen].astype(float),
                _dense(observations, frames, chosen),
                np.asarray(frames.index)[chosen],
                np.asarray(frames.similarity)[chosen],
            )
            for name, system in SYSTEMS.items():
                bar.set_postfix_str(name)
                said, track = system(given), tracks[name]
                track.signal[chosen] = said.signal
                track.pose[chosen] = said.pose
                track.has_pose[chosen] = said.map_index >= 0
                bar.update()
    return tracks
