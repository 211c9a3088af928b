"""Does a loop closure bend the trajectory? A window pose graph, one candidate at a time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from taojax.baselines.models import Frames, Track, clean, median_step_m, track_of_nodes
from taojax.core.se2 import between, compose, inverse, wrap


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

    batch: int = 32
    """Frames solved at once; bounds memory."""


class _Graph(eqx.Module):
    """One window: odometry chains the poses, every frame's top candidate pulls at its pose."""

    odometry: Float[Array, "*t w 3"]
    """Row i is the motion from pose i-1 to pose i; row 0 is not used."""

    anchor: Float[Array, "*t w 2"]
    """Position of each frame's top candidate [m]."""

    heading: Float[Array, "*t"]
    """Heading of the newest candidate [rad]."""

    has_anchor: Bool[Array, "*t w"]


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
    # A frame without a candidate says as little, and costs as much, as one with a wrong candidate.
    missing = jnp.array([[1.0, 0.0]])
    return chain, jnp.where(graph.has_anchor[:, None], tame * gap, missing)


def _hang(graph: _Graph, heading: Float[Array, ""]) -> Float[Array, "w 3"]:
    """Integrate the window backwards from the newest candidate, with the robot facing `heading`."""
    newest = jnp.concatenate([graph.anchor[-1], heading[None]])

    def back(
        pose: Float[Array, "3"], motion: Float[Array, "3"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        earlier = compose(pose, inverse(motion))
        return earlier, earlier

    earlier = jax.lax.scan(back, newest, graph.odometry[1:], reverse=True)[1]
    return jnp.concatenate([earlier, newest[None]])


@eqx.filter_jit
def _solve(
    params: TrajectoryPriorParams, graphs: _Graph, loop_sd: Float[Array, ""]
) -> Float[Array, "*t"]:
    """Return the optimum cost of each graph, over both directions of travel."""
    solver = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-4)
    floor = jnp.array([params.least_m, params.drift_share, params.turn_sd_rad])

    def one(graph: _Graph, turned: Float[Array, ""]) -> Float[Array, ""]:
        args = graph, loop_sd, floor
        start = _hang(graph, graph.heading + turned)

        def cost(poses: Float[Array, "w 3"]) -> Float[Array, ""]:
            chain, loops = _residuals(poses, args)
            return 0.5 * (jnp.sum(chain**2) + jnp.sum(loops**2))

        found = optx.least_squares(
            _residuals, solver, start, args, max_steps=params.max_steps, throw=False
        )
        # A solver that diverged leaves the start in place; a comparison with NaN is false.
        before, after = cost(start), cost(found.value)
        return jnp.where(after < before, after, before)

    each = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))
    return jnp.min(each(graphs, jnp.array([0.0, jnp.pi])), axis=1)


def _windows(
    frames: Frames, top: Int[np.ndarray, " t"], newest: Int[np.ndarray, " b"], window: int
) -> _Graph:
    """Cut the windows that end at the frames `newest`, each with its last candidate as origin."""
    back = newest[:, None] - np.arange(window)[::-1][None]
    row = np.maximum(back, 0)
    place = frames.map_poses[np.maximum(top, 0)]
    # Frames before the start stand still and have no candidate.
    has_anchor = (back >= 0) & (top[row] >= 0)
    anchor = np.where(has_anchor[..., None], place[row, :2] - place[newest, None, :2], 0.0)
    odometry = np.where((back >= 1)[..., None], frames.odometry[row], 0.0)
    return _Graph(
        odometry=jnp.asarray(odometry, jnp.float32),
        anchor=jnp.asarray(anchor, jnp.float32),
        heading=jnp.asarray(place[newest, 2], jnp.float32),
        has_anchor=jnp.asarray(has_anchor),
    )


def trajectory_prior(frames: Frames, params: TrajectoryPriorParams | None = None) -> Track:
    """Score the top candidate by how far it bends the trajectory of the last frames.

    The window's odometry and the older frames' top candidates, which may be wrong and are weighed
    robustly, form a pose graph; the newest candidate is added as a loop that has to hold.

    Args:
        frames: map and log; of the lists, the top candidates.
        params: defaults when omitted.

    Returns:
        The signal is the optimum cost, dimensionless; without a candidate it is the cost of a loop
        as long as the map. `map_index` is the top candidate, -1 without one.

    Source:
        The idea of ROVER, "Robust loop closure verification with trajectory prior in repetitive
        environments", 2025, transferred from its abstract to planar windows.
    """
    params = TrajectoryPriorParams() if params is None else params
    frames = clean(frames)
    n_frames = len(frames.odometry)
    top = frames.index[:, 0] if frames.index.shape[1] else np.full(n_frames, -1)
    loop_sd = params.loop_steps * median_step_m(frames.map_poses)
    bend = np.empty(n_frames)
    for start in range(0, n_frames, params.batch):
        # Batches of one size compile once; frames after the end repeat the last one.
        newest = np.minimum(np.arange(start, start + params.batch), n_frames - 1)
        graphs = _windows(frames, top, newest, params.window)
        bend[newest] = np.asarray(_solve(params, graphs, jnp.asarray(loop_sd, jnp.float32)))
    extent_m = np.hypot(*np.ptp(frames.map_poses[:, :2], axis=0))
    signal = np.where(top >= 0, bend, 0.5 * (extent_m / loop_sd) ** 2)
    return track_of_nodes(frames.map_poses, signal.astype(np.float32), top)
