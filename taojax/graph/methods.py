"""The competing ways from a run's answers to a trajectory; none of them knows the truth."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from taojax.files.pose_graph_io import compose, inverse
from taojax.graph.answers import Answers, Closure, Run2D, Stream
from taojax.graph.consistency import consistent, exact_clique, greedy_clique
from taojax.graph.odometry import DRIFTING, FEW, Chain, Noise, dead_reckoning, estimate, steps_m
from taojax.graph.optimise import BackEnd, Solution, solve

__all__ = ["ALONE", "Outcome", "Problem", "build", "optimise", "optimise_all", "optimise_few"]

ALONE = "no closure: odometry alone, "
"""Begins the note of a method without closures."""

CLIQUE_S = 10.0
"""Time for the largest consistent set; after that the largest one found is taken."""

MOST_PAIRED = 2000
"""Closures that are compared in pairs at most: 4 million pairs take some seconds. Of more, every
second, third, ... is taken."""


MOST_FREE = 200
"""First candidates of one drive that closes on itself at most: wrong ties between free frames fill
the equations, and a thousand of them take minutes. Of more, those of every second, third, ... frame
are taken."""


class Problem(NamedTuple):
    """The graph of the test half, without closures."""

    answers: Answers
    chain: Chain
    anchor: Float[np.ndarray, "p 3"]
    """First pose of each stretch of the chain, used where no closure ties it to the map."""

    anchored: str
    """What the anchor of the first stretch is, in words."""

    area_m2: float
    """Of the box around the map."""

    first: int = 0
    """First frame of the test half, whose closures count; the chain may begin earlier."""

    every: int = 1
    """Of so many frames one hands its first candidate to the back-ends."""

    @property
    def thinned(self) -> str:
        """What must be said of that; empty where all do."""
        return f"of every {self.every}th frame" if self.every > 1 else ""


class Outcome(NamedTuple):
    """What one method made."""

    method: str
    closures: tuple[Closure, ...]
    """Handed to the back-end."""

    solution: Solution
    seconds: float
    note: str = ""
    """Anything that a reader of its row must know."""


def _cut(run: Run2D, first: int, end: int, noise: Noise) -> Chain:
    odometry, is_start = run.odometry[first:end], run.is_start[first:end].copy()
    is_start[:1] = True
    way = steps_m(odometry, run.spacing_m)
    return Chain(first, odometry, is_start, way, run.spacing_m, noise)


def _among(stream: Stream, first: int, end: int) -> np.ndarray:
    frame = np.arange(len(stream.accepted))
    return (frame >= first) & (frame < end)


def _anchors(run: Run2D, chain: Chain) -> tuple[np.ndarray, str]:
    """Return where each stretch would start on the map without closures in it, and in words."""
    final, out, said = run.answers.final, [], ""
    path = dead_reckoning(run.odometry, run.is_start)
    part = np.cumsum(run.is_start)
    has = np.isfinite(final.pose[:, 0])
    doubt = np.where(np.isnan(final.probability_wrong), np.inf, final.probability_wrong)
    for number, (low, high) in enumerate(chain.parts()):
        first, end = chain.first + low, chain.first + high
        frame = np.arange(len(has))
        before = np.flatnonzero(final.accepted & has & (part == part[first]) & (frame < first))
        inside = np.flatnonzero(has & (frame >= first) & (frame < end))
        if before.size:
            chosen = int(before[-1])
            words = f"from the last closure accepted before it, of frame {chosen}"
        elif inside.size:
            chosen = int(inside[np.argmin(doubt[inside])])
            words = f"laid on its least doubtful answer, of frame {chosen}"
        else:
            out.append(np.zeros(3))
            said = said or "from the origin of the map, for want of any answer"
            continue
        out.append(compose(final.pose[chosen], compose(inverse(path[chosen]), path[first])))
        said = said if number else words
    return np.array(out), said


def build(run: Run2D, *, calibration_end: int, first: int, window: int) -> Problem:
    """Put the graph of the test half together; odometry's noise is found on the calibration half.

    Args:
        run: from `answers.read_answers`.
        calibration_end: frames before it are the calibration half.
        first: of the test half.
        window: frames of a window.
    """
    final = run.answers.final
    low, high = run.map_pose[:, :2].min(axis=0), run.map_pose[:, :2].max(axis=0)
    area = float(np.prod(np.maximum(high - low, run.spacing_m)))
    if run.is_own:
        # Both ends of a closure are free: the graph is the whole drive, fixed at its first frame.
        path = run.odometry
        whole = _cut(run, 0, len(path), DRIFTING)
        anchor = run.map_pose[np.flatnonzero(whole.is_start)]
        n = int((run.answers.top1.accepted & _among(run.answers.top1, first, len(path))).sum())
        every = max(1, -(-n // MOST_FREE))
        return Problem(run.answers, whole, anchor, "from its first frame", area, first, every)
    accepted = final.closures(final.accepted & _among(final, 0, calibration_end))
    calibration = _cut(run, 0, calibration_end, FEW)
    noise = estimate(calibration, accepted, window, area)
    chain = _cut(run, first, len(run.odometry), noise)
    anchor, said = _anchors(run, chain)
    return Problem(run.answers, chain, anchor, said, area, first)


def _of(problem: Problem, stream: Stream, chosen: np.ndarray) -> tuple[Closure, ...]:
    return stream.closures(chosen & _among(stream, problem.first, len(stream.accepted)))


def _raw(problem: Problem, gate: float = -np.inf) -> tuple[Closure, ...]:
    """Return the first candidates whose similarity a gate lets through."""
    top1, similarity = problem.answers.top1, problem.answers.similarity
    is_turn = np.arange(len(similarity)) % problem.every == 0
    return _of(problem, top1, top1.accepted & is_turn & (similarity >= gate))


def optimise(
    problem: Problem,
    method: str,
    closures: Sequence[Closure],
    back_end: BackEnd,
    *,
    note: str = "",
    before_s: float = 0.0,
) -> Outcome:
    """Solve the graph with some closures and take the time.

    Args:
        problem: from `build`.
        method: its name.
        closures: handed to the back-end.
        back_end: see `optimise.solve`.
        note: what a reader of its row must know.
        before_s: seconds spent on choosing the closures.
    """
    start = time.perf_counter()
    solution = solve(problem.chain, closures, back_end, problem.anchor, problem.area_m2)
    took = before_s + time.perf_counter() - start
    if not closures:
        note = f"{ALONE}{problem.anchored}"
    return Outcome(method, tuple(closures), solution, took, note)


def _paired(problem: Problem, closures: tuple[Closure, ...]) -> list[Outcome]:
    """Return both kinds of PCM with plain least squares."""
    start = time.perf_counter()
    every = -(-len(closures) // MOST_PAIRED) or 1
    thinned = closures[::every]
    note = f"of every {every}th answer" if every > 1 else problem.thinned
    agree = consistent(problem.chain, thinned)
    pairs_s = time.perf_counter() - start
    found = []
    for name, search in (
        ("pcm_greedy", lambda: greedy_clique(agree)),
        ("pcm_exact", lambda: exact_clique(agree, CLIQUE_S)),
    ):
        start = time.perf_counter()
        clique = search()
        took = pairs_s + time.perf_counter() - start
        late = f"stopped after {CLIQUE_S:g} s: perhaps not the largest consistent set"
        said = note if clique.is_largest or name == "pcm_greedy" else late
        chosen = [thinned[row] for row in clique.rows]
        found.append(optimise(problem, name, chosen, "plain", note=said, before_s=took))
    return found


def optimise_few(problem: Problem) -> list[Outcome]:
    """Run the two methods that one sentence compares: all first candidates, and ours."""
    final = problem.answers.final
    ours = _of(problem, final, final.accepted)
    return [
        optimise(problem, "top1_gnc", _raw(problem), "gnc", note=problem.thinned),
        optimise(problem, "ours", ours, "plain"),
    ]


def optimise_all(
    problem: Problem, gate: float, say: Callable[[str], None] = lambda text: None
) -> list[Outcome]:
    """Run every method but the oracle.

    Args:
        problem: from `build`.
        gate: least similarity of the first candidate that the similarity gate lets through.
        say: told the name of each method before it starts.
    """
    answers = problem.answers
    final, now = answers.final, answers.now
    raw, gated, thinned = _raw(problem), _raw(problem, gate), problem.thinned
    is_turn = np.arange(len(final.accepted)) % problem.every == 0
    ours = _of(problem, final, final.accepted)
    plans: list[tuple[str, tuple[Closure, ...], BackEnd]] = [
        ("top1_huber", raw, "huber"),
        ("top1_geman_mcclure", raw, "geman_mcclure"),
        ("top1_gnc", raw, "gnc"),
        ("gate_gnc", gated, "gnc"),
        ("ours", ours, "plain"),
        ("ours_gnc", ours, "gnc"),
        ("ours_now", _of(problem, now, now.accepted), "plain"),
        ("ours_switch", _of(problem, final, is_turn), "switch"),
    ]
    out = []
    all_frames = ("ours", "ours_gnc", "ours_now")
    for name, closures, back_end in plans:
        if name == "ours":
            say("pcm")
            out += _paired(problem, raw)
        say(name)
        note = "" if name in all_frames else thinned
        out.append(optimise(problem, name, closures, back_end, note=note))
    return out
