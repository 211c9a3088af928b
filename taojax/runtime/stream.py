"""Causal replay: one frame in, one record with every signal out, constant memory.

Larger signals mean more likely off the map.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from taojax.config import Config, StreamConfig
from taojax.core.cost import Branch, BranchCost, CostParams, branch_cost, huber
from taojax.core.history import push
from taojax.core.procrustes import diagnose, weighted_mean
from taojax.core.reductions import first_argmin, sum_over_frames
from taojax.core.se2 import inverse, transform
from taojax.errors import InputError
from taojax.runtime import hindsight
from taojax.runtime.frames import (
    DEGENERATE,
    NO_CANDIDATES,
    OK,
    WARMING_UP,
    Frame,
    Signals,
    StreamRecord,
    check_frame,
)
from taojax.runtime.maps import MapTables

WINDOWS = (5, 10, 20)
"""Lengths of the windowed top-1 signals, frames."""

SUE_CANDIDATES = 10

SUE_SHARPNESS = 20.0
"""Weights of the spatial spread: softmax(20 s) over the top 10."""


def top1(similarity: Float[Array, " k"]) -> Float[Array, ""]:
    """Return 1 - similarity of the best candidate; 1 without one."""
    return 1.0 - similarity[0]


def windowed_means(history: Float[Array, " w"], n_seen: Int[Array, ""]) -> Float[Array, " l"]:
    """Return the means of a signal over its last frames, one per length in `WINDOWS`.

    Args:
        history: oldest first, newest last.
        n_seen: how many entries are filled, from the end.
    """
    age = jnp.arange(history.shape[0])[::-1, None]
    lengths = jnp.minimum(jnp.asarray(WINDOWS), n_seen)
    is_in = (age < lengths[None]).astype(history.dtype)
    return sum_over_frames(is_in * history[:, None]) / jnp.maximum(
        lengths.astype(history.dtype), 1.0
    )


def margin(similarity: Float[Array, " k"]) -> Float[Array, ""]:
    """Return -(s_1 - s_2); a missing second candidate counts as similarity 0."""
    second = similarity[1] if similarity.shape[0] > 1 else jnp.zeros_like(similarity[0])
    return -(similarity[0] - second)


def entropy(
    similarity: Float[Array, " k"],
    is_there: Bool[Array, " k"],
    temperature: float | Float[Array, ""],
) -> Float[Array, ""]:
    """Return the entropy of the softmax of the similarities [nat]; log K without candidates."""
    logits = (similarity - similarity[0]) / temperature
    weight = jnp.where(is_there, jnp.exp(logits), 0.0)
    # -sum p log p with p = w / total, where log w is the logit.
    total, energy = sum_over_frames(
        jnp.stack([weight, weight * jnp.where(is_there, logits, 0.0)], 1)
    )
    safe = jnp.where(total > 0, total, 1.0)
    nats = jnp.maximum(jnp.log(safe) - energy / safe, 0.0)
    return jnp.where(total > 0, nats, jnp.log(float(similarity.shape[0])))


def velocity(
    position: Float[Array, "2"],
    previous: Float[Array, "2"],
    has_both: Bool[Array, ""],
    odometry: Float[Array, "3"],
) -> Float[Array, ""]:
    """Return the absolute difference between the top-1 step and the odometry step [m].

    0 while there is no pair of top-1 positions to compare.
    """
    retrieved = jnp.hypot(position[0] - previous[0], position[1] - previous[1])
    driven = jnp.hypot(odometry[0], odometry[1])
    return jnp.where(has_both, jnp.abs(retrieved - driven), 0.0)


def sue(
    positions: Float[Array, "k 2"], similarity: Float[Array, " k"], is_there: Bool[Array, " k"]
) -> Float[Array, ""]:
    """Return the weighted variance of the top-10 positions, x and y summed [m^2].

    Source:
        Spatial uncertainty estimation, CVPR 2024; constants of data_specs/signals.toml.
    """
    n = min(SUE_CANDIDATES, similarity.shape[0])
    logits = SUE_SHARPNESS * (similarity[:n] - similarity[0])
    weight = jnp.where(is_there[:n], jnp.exp(logits), 0.0)
    # Relative to the best candidate, so that far-off map coordinates cost no digits.
    offset = positions[:n] - positions[:1]
    mean = weighted_mean(offset, weight)
    across, up = weighted_mean((offset - mean[None]) ** 2, weight)
    return across + up


WARM_FRAMES = 3
"""Frames seen before anything is said of a place."""

COMPILING = "compiling once"
"""On a bar until the first frames are done, some 5 to 20 s: one that stands still alarms."""


class StreamState(eqx.Module):
    """Everything remembered between frames; every shape is fixed by the config.

    The window lies oldest first. It is shifted, not addressed as a ring: re-basing rewrites every
    pose anyway, and the shift keeps time order for the velocity term.
    """

    p: Float[Array, "n 2"]
    """Local positions of the window; the newest is the origin, so float32 stays exact."""

    q: Float[Array, "n 2 k"]
    """Rank anchors; branches innermost, as `branch_cost` wants them."""

    similarity: Float[Array, "n k"]
    has_anchor: Bool[Array, "n k"]
    is_filled: Bool[Array, " n"]
    """False for frames before the start."""

    weight: Float[Array, " n"]
    """w_i of Eq. 1 as given, 0 before the start."""

    top1: Float[Array, " h"]
    """Past top-1 signals, oldest first."""

    n_seen: Int[Array, ""]
    """Frames so far; stops counting at the longest window, so that it never wraps."""

    filter: hindsight.State | None
    """None under rank association."""


def cost_params(config: StreamConfig, tables: MapTables) -> CostParams:
    """Return the weights of Eq. 1 with length scales in metres of this map."""
    delta_m = config.delta_spacings * tables.spacing_m
    mask_m = config.mask_deltas * delta_m
    return CostParams(
        lambda_velocity=config.lambda_velocity,
        gamma_similarity=config.gamma_similarity,
        tau_missing=config.tau_masks * huber(mask_m**2, delta_m),
        delta_m=delta_m,
        mask_m=mask_m,
    )


def rank_costs(
    config: StreamConfig,
    params: CostParams,
    p: Float[Array, "n 2"],
    branches: Branch,
    weight: Float[Array, " n"],
) -> BranchCost:
    """Return Eq. 1 of every rank branch: at the closed form, or at its minimum where asked for."""
    if not config.refine:
        return branch_cost(params, p, branches, weight)
    from taojax.core.refine import refined_costs  # its solver takes up to two seconds to load

    return refined_costs(params, p, branches, weight)


def _whole(config: Config | StreamConfig) -> Config:
    if not isinstance(config, Config | StreamConfig):
        got = type(config).__name__
        raise InputError(f"config: expected Config or StreamConfig, got {got}")
    return config if isinstance(config, Config) else Config(stream=config)


def init(config: Config | StreamConfig, tables: MapTables) -> StreamState:
    """Return the state before the first frame on this map.

    Args:
        config: settings; those of the judge change nothing, and with the stream's alone the filter
            has its defaults.
        tables: from `map_tables`.
    """
    config = _whole(config)
    n, k = config.stream.window, config.stream.branches
    is_joint = config.stream.association == "joint"
    return StreamState(
        p=jnp.zeros((n, 2)),
        q=jnp.zeros((n, 2, k)),
        similarity=jnp.zeros((n, k)),
        has_anchor=jnp.zeros((n, k), bool),
        is_filled=jnp.zeros(n, bool),
        weight=jnp.zeros(n),
        top1=jnp.zeros(max(WINDOWS)),
        n_seen=jnp.zeros((), jnp.int32),
        filter=hindsight.init(config.verdict, tables) if is_joint else None,
    )


def _own_weight(frame: Frame, like: Array) -> Array:
    if frame.weight is None:
        return jnp.ones((), like.dtype)
    is_good = jnp.isfinite(frame.weight) & (frame.weight > 0)
    return jnp.where(is_good, frame.weight, 0.0).astype(like.dtype)


def window_weight(given: Float[Array, " n"], is_filled: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Return the weights of a window, summing to one; all alike where none weighs anything."""
    filled = is_filled.astype(given.dtype)
    own = jnp.where(sum_over_frames(given) > 0, given, filled)
    return own / sum_over_frames(own)


def _share(is_inlier: Bool[Array, " n"], is_filled: Bool[Array, " n"]) -> Float[Array, ""]:
    """Return the share of the filled window frames that are inliers."""
    n_in, n = sum_over_frames(jnp.stack([is_inlier, is_filled], axis=1).astype(jnp.float32))
    return n_in / n


def check_state(config: Config, tables: MapTables, state: StreamState) -> None:
    """Refuse a state of other settings or of another map.

    Raises:
        InputError: it does not have the shapes that `init` gives.
    """
    want = jax.eval_shape(init, config, tables)
    shapes = lambda tree: [leaf.shape for leaf in jax.tree.leaves(tree)]
    if jax.tree.structure(state) != jax.tree.structure(want) or shapes(state) != shapes(want):
        raise InputError(
            "state: of other settings or another map; make it with init(config, tables)"
        )


def clean(config: StreamConfig, tables: MapTables, frame: Frame) -> tuple[Array, Array, Array]:
    """Return odometry, index and similarity of the K branches with every defect made harmless.

    A frame whose odometry is not finite stands still and has no candidates, so that it can hurt
    only the windows that contain it.
    """
    k = config.branches
    is_usable = jnp.all(jnp.isfinite(frame.odometry))
    odometry = jnp.where(is_usable, frame.odometry, 0.0)
    room = max(0, k - frame.index.shape[0])
    index = jnp.pad(frame.index[:k], (0, room), constant_values=-1)
    similarity = jnp.pad(frame.similarity[:k], (0, room))
    m = tables.places.grid.xy.shape[0]
    is_there = (index >= 0) & (index < m) & jnp.isfinite(similarity) & is_usable
    return odometry, jnp.where(is_there, index, -1), jnp.where(is_there, similarity, 0.0)


@jax.jit
def step(
    config: Config | StreamConfig, tables: MapTables, state: StreamState, frame: Frame
) -> tuple[StreamState, StreamRecord]:
    """Advance by one frame.

    Args:
        config: fixed for the whole stream, as given to `init`.
        tables: the map, from `map_tables`.
        state: from `init` or the previous `step`; same structure, shapes and dtypes come out.
        frame: one observation. NaN and rows outside the map count as missing.

    Returns:
        The next state and this frame's record. Nothing is ever NaN or infinite; what went wrong
        is in `status`.

    Raises:
        InputError: arrays of a wrong shape or type, before the first frame is computed. Values are
            checked once, at the door, by `load_observations`.
    """
    check_frame(frame)
    config = _whole(config)
    check_state(config, tables, state)
    state, record = _literal(config.stream, tables, state, frame)
    if state.filter is None:
        return state, record
    seen = hindsight.cleaned(tables, frame.odometry, frame.index, frame.similarity)
    known, answer = hindsight.advance(config.verdict, tables, state.filter, seen)
    return eqx.tree_at(lambda s: s.filter, state, known), with_answer(record, answer)


@jax.jit
def with_answer(record: StreamRecord, answer: hindsight.Answer) -> StreamRecord:
    """Return records whose `tao` and pose are the filter's.

    Args:
        record: of rank branches; any leading axes.
        answer: causal answers to the same frames.
    """
    # The filter's answer needs no window of its own, but nothing is said without candidates.
    status = jnp.where(record.status == DEGENERATE, OK, record.status)
    has_pose = status == OK
    tao = record.signals.names.index("tao")
    table = jnp.asarray(record.signals.table).at[..., tao].set(hindsight.tao(answer.features))
    return StreamRecord(
        status=status,
        map_index=jnp.where(has_pose, answer.map_index, -1),
        pose=jnp.where(has_pose[..., None], answer.pose, 0.0),
        has_pose=has_pose,
        signals=Signals(record.signals.names, table),
    )


def literal(config: Config) -> StreamConfig:
    """Return the settings of the literal stream: a log's filter runs apart, with hindsight."""
    return dataclasses.replace(config.stream, association="rank")


def answered(config: Config, record: StreamRecord, now: hindsight.Answer) -> StreamRecord:
    """Return what `step` says of a log, put together from a literal replay and causal answers.

    Args:
        config: settings; under rank association the records stay as they are.
        record: from `replay` with `literal(config)`.
        now: answers to the same frames.
    """
    is_rank = config.stream.association == "rank"
    return record if is_rank else jax.tree.map(np.asarray, with_answer(record, now))


def _literal(
    config: StreamConfig, tables: MapTables, state: StreamState, frame: Frame
) -> tuple[StreamState, StreamRecord]:
    """Advance the paper's system: windows, rank branches and the signals of one view."""
    odometry, index, similarity = clean(config, tables, frame)
    is_there = index >= 0
    anchors = jnp.where(is_there[:, None], tables.places.grid.xy[index], 0.0)
    p = push(transform(inverse(odometry)[None], state.p), jnp.zeros(2))
    q, s = push(state.q, anchors.T), push(state.similarity, similarity)
    has_anchor = push(state.has_anchor, is_there)
    is_filled = push(state.is_filled, jnp.ones((), bool))
    given = push(state.weight, _own_weight(frame, p))
    weight = window_weight(given, is_filled)

    params = cost_params(config, tables)
    branches = Branch(jnp.swapaxes(q, 1, 2), s, has_anchor)
    costs = rank_costs(config, params, p, branches, weight)
    cheapest = first_argmin(costs.total)
    # The signal is the minimum over all branches; a pose needs a candidate in the newest frame.
    has_candidates = jnp.any(is_there)
    rank = first_argmin(jnp.where(is_there | ~has_candidates, costs.total, jnp.inf))
    shape = diagnose(p, q[:, :, rank], jnp.where(has_anchor[:, rank], weight, 0.0), config.eps)

    n_seen = jnp.minimum(state.n_seen + 1, max(config.window, *WINDOWS))
    history = push(state.top1, top1(similarity))
    previous = state.q[-1, :, 0]
    had_previous = state.has_anchor[-1, 0] & state.is_filled[-1]
    means = windowed_means(history, n_seen)
    windowed = {f"top1_w{n}": mean for n, mean in zip(WINDOWS, means, strict=True)}
    values = {
        "top1": top1(similarity),
        **windowed,
        "margin": margin(similarity),
        "entropy": entropy(similarity, is_there, config.entropy_temperature),
        "velocity": jnp.where(
            has_candidates,
            velocity(anchors[0], previous, had_previous & is_there[0], odometry),
            tables.extent_m,
        ),
        "sue": jnp.where(has_candidates, sue(anchors, similarity, is_there), tables.extent_m**2),
        # Candidates off the map scatter over it and span an area that no driven window does.
        "c_geom": shape.c_geom,
        "a_aniso": 0.0 - shape.a_aniso,
        "h_proxy": 0.0 - shape.h_proxy,
        "tao": costs.total[cheapest],
        "tao_rank": costs.total[cheapest],
        "tao_rank_geom": costs.geom[cheapest],
        "tao_rank_vel": costs.vel[cheapest],
        "tao_rank_sim": costs.sim[cheapest],
        "support": 1.0 - _share(costs.is_inlier[:, rank], is_filled),
    }

    is_warm = n_seen >= WARM_FRAMES
    has_pose = has_candidates & is_warm
    status = jnp.where(costs.is_degenerate[rank], DEGENERATE, OK)
    status = jnp.where(has_candidates, status, NO_CANDIDATES)
    status = jnp.where(is_warm, status, WARMING_UP)
    record = StreamRecord(
        status=status,
        map_index=jnp.where(has_pose, index[rank], -1),
        pose=jnp.where(has_pose, costs.T_map_odom[rank], 0.0),
        has_pose=has_pose,
        signals=Signals(tuple(values), jnp.stack(list(values.values()))),
    )
    state = StreamState(
        p=p,
        q=q,
        similarity=s,
        has_anchor=has_anchor,
        is_filled=is_filled,
        weight=given,
        top1=history,
        n_seen=n_seen,
        filter=state.filter,
    )
    return state, record


@jax.jit
def replay(
    config: Config | StreamConfig,
    tables: MapTables,
    frames: Frame,
    state: StreamState | None = None,
) -> tuple[StreamState, StreamRecord]:
    """Run `step` over a whole log.

    Args:
        config: fixed for the whole stream.
        tables: the map, from `map_tables`.
        frames: every leaf with a leading time axis.
        state: where to go on; from `init` when omitted.

    Returns:
        The final state and one record per frame, the same as from single steps.

    Raises:
        InputError: arrays of a wrong shape or type.
    """
    check_frame(frames, axes=1)
    start = init(config, tables) if state is None else state
    return jax.lax.scan(lambda carry, frame: step(config, tables, carry, frame), start, frames)
