"""A seeded, simulated two-session world in the manner of STheReO-KAIST.

Everything here is simulated: a closed loop of road, driven more than once by a mapping session and
by a query session, seen through descriptors that alias. The query session's poses carry a nearly
constant offset in the map frame against the places whose appearance was seen, as between two
drives that were georeferenced apart; on the default seed this gives the paper's Table 1.

The arithmetic is element-wise in a fixed order and every result is rounded to a coarse grid, so
that a seed gives the same bytes on every machine under the same NumPy.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from taojax.datasets.appearance import (
    CELL_M,
    appearance,
    at,
    lengths,
    map_view,
    process,
    query_view,
)
from taojax.datasets.trajectory import motions
from taojax.datasets.world import DECIMALS, World, WorldConfig, write_world
from taojax.errors import ConfigError

__all__ = [
    "World", "WorldConfig", "describe_routes", "make_world", "seen_places",
    "simulated_odometry", "write_world",
]  # fmt: skip

# One random stream per purpose: turning one knob leaves all other draws as they were.
_ROUTE, _OFFSET, _FIELD, _MAP, _QUERY, _ODOMETRY = range(6)


def make_world(config: WorldConfig, seed: int) -> World:
    """Simulate a map session and a query session on one road.

    Args:
        config: the knobs; they and `route_seed` fix the road and the session offset.
        seed: everything else: frame spacing, appearance, noise.

    Returns:
        The world; the same configuration and seed give the same bytes.

    Raises:
        ConfigError: if the seed is negative.

    Source:
        The paper's Table 1, which the default configuration approaches on every seed.
    """
    road_xy = _road(config)
    map_rng, query_rng = _stream(seed, _MAP), _stream(seed, _QUERY)
    map_arc_m = _frames(map_rng, config.n_map, config.driven_m, config.map_spacing_sd)
    query_arc_m = _frames(query_rng, config.n_query, config.driven_m, config.query_spacing_sd)
    map_xy = at(road_xy, map_arc_m) + _wander(map_rng, road_xy, map_arc_m, config)
    query_xy = at(road_xy, query_arc_m) + _session_offset(road_xy, query_arc_m, config)

    field = appearance(_stream(seed, _FIELD), len(road_xy), config)
    query_poses = _poses(query_xy, query_arc_m / config.speed_mps)
    odometry = simulated_odometry(query_poses[:, 1:], config, _stream(seed, _ODOMETRY))
    return World(
        map_poses=_poses(map_xy, map_arc_m / config.speed_mps),
        map_descriptors=map_view(map_rng, field, map_arc_m, config),
        odometry=_rounded(query_poses[:, 0], *odometry.T),
        query_descriptors=query_view(query_rng, field, query_arc_m, config),
        query_poses=query_poses,
    )


def seen_places(config: WorldConfig, seed: int) -> Float[np.ndarray, "t 2"]:
    """Return where in the map the appearance of each query frame belongs, metres.

    Args:
        config: the knobs of a world.
        seed: its seed.
    """
    # Each knob has its own random stream: without the offset the same places are driven.
    return make_world(replace(config, offset_cap_m=0.0), seed).query_poses[:, 1:3]


def simulated_odometry(
    poses: Float[np.ndarray, "t 3"], config: WorldConfig, seed: int | np.random.Generator
) -> Float[np.ndarray, "t 3"]:
    """Measure the motion between true poses with the noise that `config` states.

    Args:
        poses: rows (x [m], y [m], theta [rad]).
        config: white noise per root of a driven metre, constant scale and yaw errors.
        seed: of the noise, or the generator that draws it.

    Returns:
        Forward [m], left [m], yaw [rad]; row 0 is zero.
    """
    out = motions(poses)
    driven_m = lengths(out[1:, :2])
    white = np.random.default_rng(seed).standard_normal((len(driven_m), 3)) * np.sqrt(driven_m)
    out[1:, :2] *= 1.0 + config.odometry_scale
    out[1:, 2:] += config.odometry_yaw_rad_per_m * driven_m
    out[1:] += np.array([[config.odometry_m, config.odometry_m, config.odometry_rad]]) * white
    return out


def describe_routes(
    map_poses: Float[np.ndarray, "m 4"],
    query_poses: Float[np.ndarray, "t 4"],
    config: WorldConfig,
    seed: int,
) -> tuple[Float32[np.ndarray, "m d"], Float32[np.ndarray, "t d"]]:
    """Simulate descriptors for two given, real pose sequences.

    Appearance belongs to places: a frame within `reach_m` of an earlier place of either route sees
    what is seen there, in both driving directions, and any other frame opens a new place whose
    appearance is independent. The poses carry their own session offset; none is added.

    Args:
        map_poses: rows (t [s], x [m], y [m], theta [rad]) of the map session.
        query_poses: the same for the query session.
        config: the appearance and noise knobs; those of the road are not used.
        seed: seed of the appearance and the noise.

    Returns:
        Simulated descriptors of the map and of the query frames, of unit length.
    """
    map_arc_m, query_arc_m, axis_m = _place_axis(map_poses, query_poses, config)
    field = appearance(_stream(seed, _FIELD), int(np.ceil(axis_m / CELL_M)), config)
    return (
        map_view(_stream(seed, _MAP), field, map_arc_m, config),
        query_view(_stream(seed, _QUERY), field, query_arc_m, config),
    )


def _stream(seed: int, purpose: int) -> np.random.Generator:
    if seed < 0:
        raise ConfigError(f"seed {seed} must not be negative")
    return np.random.default_rng([seed, purpose])


def _road(config: WorldConfig) -> np.ndarray:
    """Draw the closed road: a circle with five random harmonics, in cells of equal length."""
    rng = _stream(config.route_seed, _ROUTE)
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    radius = np.ones_like(angle)
    for k in range(2, 7):
        amplitude = 0.22 / np.sqrt(k - 1.0) * rng.standard_normal()
        radius += amplitude * np.cos(k * angle + rng.uniform(0.0, 2.0 * np.pi))
    radius = np.maximum(radius, 0.35)
    xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    arc = np.concatenate([[0.0], np.cumsum(lengths(np.diff(xy, axis=0))[:, 0])])
    n_cells = int(np.ceil(config.loop_m / CELL_M))
    wanted = np.arange(n_cells) / n_cells * arc[-1]
    resampled = np.stack([np.interp(wanted, arc, xy[:, axis]) for axis in range(2)], axis=1)
    return (resampled - resampled[:1]) * (n_cells * CELL_M / arc[-1])


def _frames(rng: np.random.Generator, n: int, driven_m: float, spacing_sd: float) -> np.ndarray:
    """Draw the distances driven at which frames are taken."""
    steps = np.maximum(1.0 + spacing_sd * rng.standard_normal(n), 0.2)
    driven = np.cumsum(steps)
    return (driven - driven[0]) * (driven_m / driven[-1])


def _tangent(xy: np.ndarray) -> np.ndarray:
    ahead = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    return ahead / lengths(ahead)


def _wander(
    rng: np.random.Generator, road_xy: np.ndarray, arc_m: np.ndarray, config: WorldConfig
) -> np.ndarray:
    """Draw the lateral displacement of the map session from the middle of the lane."""
    ahead = at(_tangent(road_xy), arc_m)
    n_cells = int(np.ceil(config.driven_m / CELL_M)) + 1
    left_m = config.map_wander_m * process(rng, (n_cells, 1), config.wander_length_m / CELL_M)
    return at(left_m, arc_m) * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)


def _session_offset(road_xy: np.ndarray, arc_m: np.ndarray, config: WorldConfig) -> np.ndarray:
    """Draw where the query session says it is, minus where the map session says the place is."""
    rng = _stream(config.route_seed, _OFFSET)
    n_cells = int(np.ceil(config.driven_m / CELL_M)) + 1
    slow = process(rng, (n_cells, 2), config.offset_noise_length_m / CELL_M)
    direction = config.offset_direction_rad
    offset = config.offset_m * np.array([[np.cos(direction), np.sin(direction)]])
    offset = offset + config.offset_lag_m * at(_tangent(road_xy), arc_m)
    offset = offset + config.offset_noise_m * at(slow, arc_m)
    return offset * np.minimum(1.0, config.offset_cap_m / np.maximum(lengths(offset), 1e-9))


def _rounded(*columns: np.ndarray) -> np.ndarray:
    # Adding zero turns -0.0 into 0.0, which prints without its sign.
    pairs = zip(columns, DECIMALS, strict=True)
    return np.stack([np.round(column, places) + 0.0 for column, places in pairs], axis=1)


def _poses(xy: np.ndarray, t_s: np.ndarray) -> np.ndarray:
    """Complete positions to poses that head where they drive."""
    ahead = np.concatenate([xy[1:2] - xy[:1], xy[2:] - xy[:-2], xy[-1:] - xy[-2:-1]])
    return _rounded(t_s, xy[:, 0], xy[:, 1], np.arctan2(ahead[:, 1], ahead[:, 0]))


def _place_axis(
    map_poses: np.ndarray, query_poses: np.ndarray, config: WorldConfig
) -> tuple[np.ndarray, np.ndarray, float]:
    """Give every frame of two routes a place coordinate [m]; same place, same coordinate."""
    poses = np.concatenate([map_poses, query_poses])
    xy, theta = poses[:, 1:3], poses[:, 3]
    n_map, gap_m = len(map_poses), 6.0 * config.ell_m
    step_m = np.concatenate([[0.0], lengths(np.diff(xy, axis=0))[:, 0]])
    step_m[n_map] = np.inf  # the sessions start apart
    driven_m = np.cumsum(np.where(np.isfinite(step_m), step_m, 1e6))
    onward = np.stack([np.cos(theta), np.sin(theta)], axis=1)  # where the coordinate grows
    arc_m = np.zeros(len(poses))
    is_new = np.zeros(len(poses), dtype=bool)
    top_m = -gap_m
    for i in range(len(poses)):
        # The stretch just driven is not a revisit.
        n_old = int(np.searchsorted(driven_m, driven_m[i] - 3.0 * config.reach_m))
        away = xy[i] - xy[:n_old]
        square = away[:, 0] ** 2 + away[:, 1] ** 2
        near = int(np.argmin(square)) if n_old else -1
        if near >= 0 and square[near] <= config.reach_m**2:
            arc_m[i] = arc_m[near] + np.sum(away[near] * onward[near])
            if np.sum(onward[i] * onward[near]) < 0.0:
                onward[i] = -onward[i]
            continue
        is_new[i] = True
        goes_on = i > 0 and is_new[i - 1] and step_m[i] < gap_m
        arc_m[i] = arc_m[i - 1] + step_m[i] if goes_on else top_m + gap_m
        top_m = max(top_m, arc_m[i])
    return arc_m[:n_map], arc_m[n_map:], top_m + gap_m
