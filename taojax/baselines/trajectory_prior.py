"""Does a loop closure bend the trajectory? A window pose graph, one candidate at a time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from taojax.baselines.frames import Frames, Track, clean, track_of_nodes
from taojax.baselines.models import median_step_m
from taojax.core.se2 import between, compose, wrap


class TrajectoryPriorParams(eqx.Module):
    """Defaults; the paper's own numbers belong to three-dimensional laser odometry."""

    window: int = 10
    """Poses in the graph, frames, at least 2."""

    drift_share: float = 0.1
    """Standard deviation of an odometry step as a share of its length."""

    least_m: float = 0.05
    """Floor of that deviation, metres."""

    turn_sd_rad: float = 0.05
    """Standard deviation of an odometry turn, radians."""

    loop_steps: float = 2.0
    """Standard deviation of a loop closure in median steps of the map."""

    max_steps: int = 20
    """Iterations of the solver per frame."""

    batch: int = 64
    """Frames solved at once; bounds memory."""


class _Graph(eqx.Module):
    """One window: odometry chains the poses, every frame's top candidate pulls at its pose."""

    odometry: Float[Array, "*t w 3"]
    """Row i is the motion from pose i-1 to pose i; row 0 is not used."""

    anchor: Float[Array, "*t w 2"]
    """Position of each frame's top candidate [m]."""

    has_anchor: Bool[Array, "*t w"]
    start: Float[Array, "*t w 3"]
    """First guess: the odometry hung on the newest candidate."""


def _residuals(
    poses: Float[Array, "w 3"],
    args: tuple[_Graph, Float[Array, ""], Float[Array, "3"]],
) -> tuple[Float[Array, "v 3"], Float[Array, "w 2"]]:
    """Return whitened odometry and loop residuals; old loops are robust, the newest is not."""
    graph, loop_sd, floor = args
    step = between(poses[:-1], poses[1:])
    error = step - graph.odometry[1:]
    error = jnp.concatenate([error[:, :2], wrap(error[:, 2:])], axis=-1)
    drive = jnp.sqrt(jnp.sum(graph.odometry[1:, :2] ** 2, axis=-1, keepdims=True))
    move_sd = jnp.sqrt(floor[0] ** 2 + (floor[1] * drive) ** 2)
    chain = error / jnp.concatenate([move_sd, move_sd, 0.0 * move_sd + floor[2]], axis=-1)
    gap = (graph.anchor - poses[:, :2]) / loop_sd
    squared = jnp.sum(gap**2, axis=-1, keepdims=True)
    # Geman-McClure: a wrong earlier retrieval costs at most 1 and does not bend the trajectory.
    is_newest = (jnp.arange(gap.shape[0]) == gap.shape[0] - 1)[:, None]
    tame = jnp.where(is_newest, 1.0, jax.lax.rsqrt(1.0 + squared))
    return chain, jnp.where(graph.has_anchor[:, None], tame * gap, 0.0)


@eqx.filter_jit
def _solve(
    params: TrajectoryPriorParams, graphs: _Graph, loop_sd: Float[Array, ""]
) -> tuple[Float[Array, " t"], Float[Array, "t 3"]]:
    solver = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-4)
    floor = jnp.array([params.least_m, params.drift_share, params.turn_sd_rad])

    def cost(poses: Float[Array, "w 3"], args: tuple) -> Float[Array, ""]:
        return 0.5 * sum(jnp.sum(part**2) for part in _residuals(poses, args))

    def one(graph: _Graph) -> tuple[Float[Array, ""], Float[Array, "3"]]:
        args = graph, loop_sd, floor
        found = optx.least_squares(
            _residuals, solver, graph.start, args, max_steps=params.max_steps, throw=False
        )
        before, after = cost(graph.start, args), cost(found.value, args)
        # A solver that diverged, or stopped above its start, leaves the start in place.
        is_better = after < before
        return jnp.where(is_better, after, before), jnp.where(
            is_better, found.value[-1], graph.start[-1]
        )

    return jax.lax.map(one, graphs, batch_size=params.batch)


def _graphs(frames: Frames, window: int) -> tuple[_Graph, Float[np.ndarray, "t 2"]]:
    """Cut one window per frame, each around its newest candidate; returns the origins taken out."""
    n_frames = len(frames.odometry)
    top = frames.index[:, 0] if frames.index.shape[1] else np.full(n_frames, -1)
    back = np.arange(n_frames)[:, None] - np.arange(window)[::-1][None]
    row = np.maximum(back, 0)
    # Frames before the start stand still and have no candidate.
    odometry = np.where((back >= 1)[..., None], frames.odometry[row], 0.0)
    has_anchor = (back >= 0) & (top[row] >= 0)
    place = frames.map_poses[np.maximum(top, 0)]
    origin = place[:, :2]
    anchor = np.where(has_anchor[..., None], place[row, :2] - origin[:, None], 0.0)
    return (
        _Graph(
            odometry=jnp.asarray(odometry, jnp.float32),
            anchor=jnp.asarray(anchor, jnp.float32),
            has_anchor=jnp.asarray(has_anchor),
            start=_hang(jnp.asarray(odometry, jnp.float32), jnp.asarray(place[:, 2], jnp.float32)),
        ),
        origin,
    )


@jax.jit
def _hang(odometry: Float[Array, "t w 3"], heading: Float[Array, " t"]) -> Float[Array, "t w 3"]:
    """Integrate each window backwards from the origin, where its newest pose is."""
    from taojax.core.se2 import inverse

    newest = jnp.stack([0.0 * heading, 0.0 * heading, heading], axis=-1)
    poses = [newest]
    for i in range(odometry.shape[1] - 1, 0, -1):
        poses.append(compose(poses[-1], inverse(odometry[:, i])))
    return jnp.stack(poses[::-1], axis=1)


def trajectory_prior(frames: Frames, params: TrajectoryPriorParams | None = None) -> Track:
    """placeholder."""
    params = TrajectoryPriorParams() if params is None else params
    frames = clean(frames)
    graphs, origin = _graphs(frames, params.window)
    loop_sd = jnp.asarray(params.loop_steps * median_step_m(frames.map_poses), jnp.float32)
    bend, newest = _solve(params, graphs, loop_sd)
    return track_of_nodes(frames.map_poses, np.asarray(bend), np.where(np.asarray(graphs.has_anchor[:, -1]), frames.index[:, 0], -1))
