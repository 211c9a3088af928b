"""A stream of JSON lines through `step`: one observation in, one answer out, for ever.

A line that is not understood is answered by an error and changes nothing. Memory is constant.
"""

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from io import BufferedIOBase
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from taojax.config import Config, StreamConfig
from taojax.decisions import SILENT, judged
from taojax.errors import InputError
from taojax.files.dataset_info import DESCRIPTORS
from taojax.files.records import digest_file
from taojax.files.specs import read_npy
from taojax.files.tables import POSE, read_table, stacked
from taojax.risk import Calibration, MapFacts, for_run, shipped
from taojax.runtime import hindsight
from taojax.runtime.frames import STATUSES, Frame, StreamRecord, check_frame
from taojax.runtime.maps import MapTables, map_tables
from taojax.runtime.observations import descriptor_names
from taojax.runtime.retrieval import N_KEPT
from taojax.runtime.stream import answered, init, literal, step

MOST_BYTES = 1 << 20
"""Longest line; what is longer is skipped up to its end, never held."""

LIMIT = {"odometry": (1e5, 1e5, 1e4), "similarity": 1.0 + 1e-3, "rise": 1e-6}
"""Ranges of data_specs/query_odometry.toml, and what `load_observations` asks of lists."""

REMEMBERED = 100_000
"""Latencies behind the summary: the last so many frames."""


LONGEST_COMPILED = 6
"""So many lags of blank frames, which stand still, are waited for until a block is final."""

COVARIANCE = ("var_x_m2", "var_y_m2", "cov_xy_m2")

BLANK = b'{"odometry": [0, 0, 0], "index": [], "similarity": []}'
"""An observation of nothing, to compile with."""


class LineError(ValueError):
    """A line is not an observation; the message says what is wrong with it."""


class Observed(NamedTuple):
    """One line, checked."""

    t_s: float | None
    odometry: Float[np.ndarray, "3"]
    rows: Int[np.ndarray, " c"]
    """Candidates, best first, -1 = none."""

    similarity: Float[np.ndarray, " c"]


class LoadedMap(NamedTuple):
    """A map that is ready to be watched."""

    tables: MapTables
    scale: str
    """Where its similarity scale comes from, in words."""

    facts: MapFacts


def load_map(folder: Path, config: StreamConfig) -> LoadedMap:
    """Prepare the map of a folder, as `taojax score` does for the same folder.

    Args:
        folder: a data folder, or one that holds poses.csv and perhaps descriptors.npy.
        config: settings.

    Raises:
        InputError: no map there, or it does not meet its spec.
    """
    inner = folder / "map" if (folder / "map" / "poses.csv").is_file() else folder
    table = read_table(inner / "poses.csv", "map_poses")
    poses = stacked(table, POSE)
    path = folder / descriptor_names(folder)[0]
    if inner == folder and path == folder / DESCRIPTORS[0][0]:
        path = folder / "descriptors.npy"
    # Lists of another frontend have a scale of their own, which the map's descriptors do not tell.
    descriptors, scale = None, "similarities are taken as they are (0 to 1)"
    if path.is_file() and not (folder / "query/retrievals.npz").is_file():
        descriptors, scale = read_npy(path, "descriptors"), f"similarity scale from {path}"
    if descriptors is not None and len(descriptors) != len(poses):
        raise InputError(
            f"{path}: {len(descriptors)} rows, but {inner / 'poses.csv'} has {len(poses)}; both "
            "must describe the same frames"
        )
    tables = map_tables(poses, config, descriptors)
    facts = MapFacts(
        poses_sha256=digest_file(inner / "poses.csv"),
        views_sha256="" if descriptors is None else digest_file(path),
        spacing_m=float(tables.spacing_m),
        recall=float(tables.recall),
    )
    return LoadedMap(tables, scale, facts)


def _not_json(text: str) -> float:
    raise LineError(f"{text} is not a number")


def _numbers(tree: dict[str, Any], name: str, kinds: tuple[type, ...]) -> list[Any]:
    values = tree.get(name)
    if not isinstance(values, list):
        raise LineError(f"{name} is missing or no list")
    for at, value in enumerate(values):
        # bool is an int to Python.
        if type(value) not in kinds or not math.isfinite(value):
            want = "a whole number" if kinds == (int,) else "a finite number"
            raise LineError(f"{name}[{at}] is not {want}")
    return values


def _check_list(index: list[int], similarity: list[float], n_map: int) -> None:
    if len(index) != len(similarity):
        raise LineError(f"index has {len(index)} entries and similarity {len(similarity)}")
    least = math.inf
    for at, (row, value) in enumerate(zip(index, similarity, strict=True)):
        if not -1 <= row < n_map:
            raise LineError(f"index[{at}] is {row}, but the map has rows 0 to {n_map - 1}")
        if row < 0:
            continue
        if value > LIMIT["similarity"]:
            raise LineError(f"similarity[{at}] is {value:g}; similarities are at most 1")
        if value > least + LIMIT["rise"]:
            raise LineError(f"similarity[{at}] rises; give candidates best first")
        least = min(least, value)


def parse(line: bytes, n_map: int) -> Observed:
    """Read one line.

    Args:
        line: JSON, with `odometry` (forward m, left m, yaw rad), `index` and `similarity` (best
            first, at most 100 are used, -1 = no candidate) and perhaps `t_s`.
        n_map: rows of the map.

    Raises:
        LineError: saying what is wrong.
    """
    try:
        tree = json.loads(line, parse_constant=_not_json)
        if not isinstance(tree, dict):
            raise LineError("is not a JSON object")
        odometry = _numbers(tree, "odometry", (int, float))
        index = _numbers(tree, "index", (int,))
        similarity = _numbers(tree, "similarity", (int, float))
        t_s = tree.get("t_s")
        if t_s is not None and (type(t_s) not in (int, float) or not math.isfinite(t_s)):
            raise LineError("t_s is not a finite number")
        _check_list(index, similarity, n_map)
        wide = len(odometry) != 3 or any(
            abs(v) > most for v, most in zip(odometry, LIMIT["odometry"], strict=False)
        )
        if wide:
            raise LineError("odometry is not [forward m, left m, yaw rad] within 1e5, 1e5 and 1e4")
    except LineError:
        raise
    except (ValueError, OverflowError, RecursionError) as error:
        raise LineError(f"is not JSON ({str(error).splitlines()[0][:80]})") from error
    return _observed(t_s, odometry, index, similarity)


def _observed(
    t_s: float | None, odometry: list[Any], index: list[Any], similarity: list[Any]
) -> Observed:
    """Return a frame whose list is as long as every other's, so that nothing is compiled anew."""
    rows, values = np.full(N_KEPT, -1, np.int32), np.zeros(N_KEPT, np.float32)
    kept = min(len(index), N_KEPT)
    rows[:kept], values[:kept] = index[:kept], similarity[:kept]
    values = np.where(rows >= 0, np.minimum(values, 1.0), 0.0).astype(np.float32)
    return Observed(t_s, np.array(odometry, np.float32), rows, values)


def lines_of(stream: BinaryIO | BufferedIOBase) -> Iterator[bytes | None]:
    """Go through the lines of a stream as they come; None stands for one that is too long."""
    while line := stream.readline(MOST_BYTES + 1):
        if len(line) <= MOST_BYTES:
            yield line
            continue
        while line and not line.endswith(b"\n"):
            line = stream.readline(MOST_BYTES)
        yield None


class Watch:
    """Two verdicts on every frame of a stream: at once, and again a lag later.

    A map, a state and what was seen so far; the first step is compiled when it is made. The one
    place with a state that changes: a process that watches is one.
    """

    def __init__(
        self, config: Config, tables: MapTables, calibration: Calibration | None = None
    ) -> None:
        """Compile the step.

        Args:
            config: settings; of the judge's only the share of accepted answers that may be wrong.
            tables: from `map_tables`.
            calibration: frozen numbers, from `read_calibration`; the shipped ones when omitted.
        """
        # The map stays an argument: folded into the program it compiles for longer, and rounds
        # differently from `taojax score`.
        self._config, self._tables, self._literal = config, tables, literal(config)
        self._calibration = for_run(
            calibration or shipped(), config.audit.max_wrong, config.verdict.lag
        )
        self._n_map = tables.places.grid.xy.shape[0]
        self.latencies_ms: deque[float] = deque(maxlen=REMEMBERED)
        self._start()
        # As many frames as a first block needs, so that its program is compiled too.
        for _ in range(LONGEST_COMPILED * (config.verdict.lag + 1)):
            self.answer(BLANK)
            if self.finals():
                break
        self._start()
        self.latencies_ms.clear()

    def _start(self) -> None:
        self._state, self._n_frames = init(self._literal, self._tables), 0
        self._follower = hindsight.Follower(self._config.verdict, self._tables)
        self._waiting: deque[tuple[float | None, str, str]] = deque()

    def answer(self, line: bytes) -> dict[str, Any]:
        """Take in one line and say what it means; one that is no observation changes nothing.

        Raises:
            LineError: saying what is wrong with the line.
        """
        start = time.perf_counter()
        return self._seen(parse(line, self._n_map), start)

    def step(self, frame: Frame, t_s: float | None = None) -> dict[str, Any]:
        """Take in one frame of a program's own and say what it means.

        Args:
            frame: one observation, NumPy or JAX; lists of any length, best first. Its weight counts
                for nothing here.
            t_s: its stamp, which is handed back.

        Returns:
            The entries of a line of kind now, see data_specs/watch.toml.

        Raises:
            InputError: arrays of a wrong shape or type, rows outside the map, or a list that is not
                best first.
        """
        start = time.perf_counter()
        check_frame(frame)
        leaves = frame.odometry, frame.index, frame.similarity
        odometry, index, similarity = (np.asarray(leaf).tolist() for leaf in leaves)
        try:
            _check_list(index, similarity, self._n_map)
        except LineError as error:
            raise InputError(f"frame: {error}") from error
        return self._seen(_observed(t_s, odometry, index, similarity), start)

    def _seen(self, seen: Observed, start: float) -> dict[str, Any]:
        frame = Frame(*(jnp.asarray(leaf) for leaf in seen[1:]))
        self._state, record = step(self._literal, self._tables, self._state, frame)
        now = self._follower.push(hindsight.clean(self._tables, *seen[1:]))
        said = self._said(seen.t_s, jax.device_get(record), now)
        self._n_frames += 1
        said["latency_ms"] = round(1e3 * (time.perf_counter() - start), 3)
        self.latencies_ms.append(said["latency_ms"])
        return said

    def finals(self) -> list[dict[str, Any]]:
        """Say what has become final since it was last asked: blocks of half a lag, oldest first.

        To be asked after every frame, or now and then; what waits is kept.
        """
        return self._finals(self._follower.finished())

    def flush(self) -> list[dict[str, Any]]:
        """Say what is final of the last frames, of which nothing more will be known."""
        return self._finals(self._follower.flush())

    def _said(
        self, t_s: float | None, record: StreamRecord, now: hindsight.Answer
    ) -> dict[str, Any]:
        record = answered(self._config, record, now)
        status = STATUSES[int(record.status)]
        one = jax.tree.map(lambda leaf: leaf[None], now)
        columns = hindsight.now_columns(one)
        verdict, why, p = judged(self._calibration.now, columns, np.array([status], dtype=object))
        self._waiting.append((t_s, status, str(verdict[0])))
        return {
            "kind": "now",
            "frame": self._n_frames,
            "t_s": t_s,
            "status": status,
            "verdict": str(verdict[0]),
            "map_index": int(now.map_index) if status not in SILENT else -1,
            "pose": [short(v) for v in now.pose.tolist()] if status not in SILENT else None,
            "probability_wrong": short(float(p[0])),
            "tao": short(float(record.signals["tao"])),
            "reason": str(why[0]),
        }

    def _finals(self, finished: list[hindsight.Finished]) -> list[dict[str, Any]]:
        lines = []
        for block in finished:
            columns = hindsight.delayed_columns(block.final)
            n = len(columns["frame"])
            before = [self._waiting.popleft() for _ in range(n)]
            status = np.array([one[1] for one in before], dtype=object)
            verdict, why, p = judged(self._calibration.final, columns, status)
            for at, (t_s, said, verdict_now) in enumerate(before):
                is_known = said not in SILENT
                pose, spread = (
                    [short(float(columns[name][at])) for name in names] if is_known else None
                    for names in (POSE, COVARIANCE)
                )
                lines.append({
                    "kind": "final",
                    "frame": block.first + at,
                    "t_s": t_s,
                    "verdict": str(verdict[at]),
                    "withdrawn": verdict_now == "accept" and verdict[at] != "accept",
                    "map_index": int(columns["map_index"][at]) if is_known else -1,
                    "pose": pose,
                    "covariance": spread,
                    "probability_wrong": short(float(p[at])),
                    "reason": str(why[at]),
                })  # fmt: skip
        return lines

    def run(self, stream: BinaryIO | BufferedIOBase, write: Callable[[str], object]) -> None:
        """Answer every line of a stream until it ends.

        Args:
            stream: of bytes; blank lines are passed over.
            write: takes one line of JSON at a time.
        """
        for number, line in enumerate(lines_of(stream), start=1):
            if line is not None and not line.strip():
                continue
            try:
                if line is None:
                    raise LineError(f"is longer than {MOST_BYTES} bytes")
                said = self.answer(line)
            except LineError as error:
                said = {"line": number, "error": str(error)}
            # At once: looking back takes ten times as long, and this frame need not wait for it.
            write(json.dumps(said))
            for said in self.finals():
                write(json.dumps(said))
        for said in self.flush():
            write(json.dumps(said))

    def summary(self) -> str:
        """Say how many frames were answered and how fast."""
        if not self.latencies_ms:
            return "0 frames answered"
        p50, p99 = np.percentile(np.array(self.latencies_ms), (50, 99))
        n = self._n_frames
        return (
            f"{n} frame{'s' if n > 1 else ''} answered; latency p50 {p50:.2f} ms, p99 {p99:.2f} ms"
        )


def short(value: float) -> float:
    """Return a number with the nine digits that tables have."""
    return float(f"{value:.9g}")
