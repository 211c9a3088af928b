"""A seeded, simulated two-session world in the manner of STheReO-KAIST.

Everything here is simulated: a closed loop of road, driven more than once by a mapping session and
by a query session, seen through descriptors that alias. The query session's poses carry a nearly
constant offset in the map frame against the places whose appearance was seen, as between two
drives that were georeferenced apart; on the default seed this gives the paper's Table 1.

The arithmetic is element-wise in a fixed order and every result is rounded to a coarse grid, so
that a seed gives the same bytes on every machine under the same NumPy.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from taojax.datasets.trajectory import motions
from taojax.errors import ConfigError, InputError

__all__ = [
    "CELL_M",
    "DECIMALS",
    "World",
    "WorldConfig",
    "appearance",
    "at",
    "describe_routes",
    "lengths",
    "make_world",
    "map_view",
    "process",
    "query_view",
    "seen_places",
    "simulated_odometry",
    "write_world",
]

DECIMALS = (3, 3, 3, 5)
"""Decimals of s, m, m and rad in every table, in memory and on disk."""

_POSE_HEADER = "t_s,x_m,y_m,theta_rad"

_ODOMETRY_HEADER = "t_s,dx_m,dy_m,dtheta_rad"


@dataclass(frozen=True)
class WorldConfig:
    """The knobs of the simulated world; a correlation length l means exp(-d^2 / (2 l^2))."""

    n_map: int = 2000
    """Map frames."""
    n_query: int = 1000
    """Query frames."""
    dimension: int = 256
    """Length of a descriptor."""
    route_seed: int = 23
    """Seed of the road and of the session offset, which stay the same for every noise seed."""
    loop_m: float = 4000.0
    """Length of the closed road, rounded up to a whole grid cell."""
    driven_m: float = 5400.0
    """Distance each session drives along it; what exceeds the loop is a revisit."""
    speed_mps: float = 5.4
    """Driving speed, which only sets the time stamps."""
    map_spacing_sd: float = 0.25
    """Standard deviation of the map's frame spacing, as a share of the mean spacing."""
    query_spacing_sd: float = 0.20
    """The same for the queries."""
    map_wander_m: float = 0.3
    """Standard deviation of the map session's lateral position in the lane."""
    wander_length_m: float = 20.0
    """Correlation length of that wander."""
    offset_m: float = 9.85
    """Length of the constant part of the query session's pose offset."""
    offset_direction_rad: float = 0.76
    """Direction of the constant offset in the map frame."""
    offset_lag_m: float = 2.6
    """Part of the offset along the driving direction."""
    offset_noise_m: float = 0.86
    """Standard deviation, per axis, of the slowly varying part of the offset."""
    offset_noise_length_m: float = 45.0
    """Correlation length of the slowly varying part."""
    offset_cap_m: float = 9.1
    """Largest length of the whole offset."""
    ell_m: float = 18.0
    """Length scale of appearance along the road."""
    alias: float = 0.45
    """Share of descriptor variance that many places have in common by their class."""
    common: float = 0.35
    """Share of descriptor variance that all places have in common."""
    reach_m: float = 10.0
    """Distance within which two frames of given routes are at one place."""
    n_alias: int = 8
    """Number of appearance classes."""
    alias_patch_m: float = 80.0
    """Stretch of road with one class."""
    alias_blend_m: float = 10.0
    """Standard deviation of the blending between neighbouring stretches."""
    map_noise: float = 0.20
    """Descriptor noise of map frames, relative to appearance of unit variance."""
    query_noise: float = 0.54
    """Median descriptor noise of query frames."""
    query_noise_frames: float = 1.1
    """Correlation length of the query noise over frames."""
    query_level_sd: float = 0.22
    """Standard deviation of the logarithm of the query noise level."""
    query_level_frames: float = 15.0
    """Correlation length of that level over frames."""
    jitter_m: float = 2.0
    """Standard deviation of the place along the road at which a query sees its appearance."""
    jitter_frames: float = 0.2
    """Correlation length of the jitter over frames."""
    hard_noise: float = 3.8
    """Extra descriptor noise of a hard query frame."""
    hard_above: float = 1.75
    """A frame is hard where a standard normal draw exceeds this."""
    odometry_m: float = 0.03
    """Odometry noise forward and left, m per square root of a driven metre."""
    odometry_rad: float = 0.003
    """Odometry yaw noise, rad per square root of a driven metre."""
    odometry_scale: float = 0.015
    """Constant scale error of the odometry."""
    odometry_yaw_rad_per_m: float = 0.0004
    """Constant yaw error of the odometry per driven metre."""

    def __post_init__(self) -> None:
        """Refuse knobs that no world can have."""
        if self.alias < 0 or self.common < 0 or self.alias + self.common >= 1:
            raise ConfigError(
                f"alias {self.alias} and common {self.common} must be >= 0 and sum to less than 1"
            )
        if min(self.n_map, self.n_query, self.dimension, self.n_alias) < 3:
            raise ConfigError("n_map, n_query, dimension and n_alias must be at least 3")
        if min(self.ell_m, self.loop_m, self.driven_m, self.speed_mps, self.alias_patch_m) <= 0:
            raise ConfigError("lengths and the speed must be positive")


NOTE = "simulated KAIST-like world: descriptors, odometry and poses are all simulated"
"""Travels in about.toml through the manifest into the report."""


@dataclass(frozen=True)
class World:
    """One simulated data set; pose rows are (t [s], x [m], y [m], theta [rad])."""

    map_poses: Float[np.ndarray, "m 4"]
    """(M, 4) poses of the map frames."""
    map_descriptors: Float32[np.ndarray, "m d"]
    """(M, D) unit-length descriptors of the map frames."""
    odometry: Float[np.ndarray, "t 4"]
    """(T, 4) motion from the frame before in its body frame (forward, left, yaw); row 0 is zero."""
    query_descriptors: Float32[np.ndarray, "t d"]
    """(T, D) unit-length descriptors of the queries."""
    query_poses: Float[np.ndarray, "t 4"]
    """(T, 4) true poses of the queries."""


def write_world(world: World, folder: Path) -> None:
    """Write a world as a data folder.

    Args:
        world: what to write.
        folder: where to; made where absent.

    Raises:
        InputError: if the folder already holds a data set.
    """
    for part in ("map", "query", "truth"):
        if (folder / part).exists():
            raise InputError(f"{folder / part} exists: choose a folder without a data set")
    for part in ("map", "query", "truth"):
        (folder / part).mkdir(parents=True)
    _write_table(folder / "map" / "poses.csv", _POSE_HEADER, world.map_poses)
    np.save(folder / "map" / "descriptors.npy", world.map_descriptors)
    _write_table(folder / "query" / "odometry.csv", _ODOMETRY_HEADER, world.odometry)
    np.save(folder / "query" / "descriptors.npy", world.query_descriptors)
    _write_table(folder / "truth" / "query_poses.csv", _POSE_HEADER, world.query_poses)
    (folder / "about.toml").write_text(f'notes = ["{NOTE}"]\n', encoding="utf-8")


def _write_table(path: Path, header: str, table: np.ndarray) -> None:
    with open(path, "w", newline="\n", encoding="ascii") as file:
        np.savetxt(file, table, [f"%.{d}f" for d in DECIMALS], ",", header=header, comments="")


CELL_M = 2.0
"""Spacing of every grid along the road."""

_DESCRIPTOR_GRID = 2.0**14  # descriptor values are multiples of its inverse


def appearance(rng: np.random.Generator, n_cells: int, config: WorldConfig) -> np.ndarray:
    """Draw the appearance of every cell of a road: its own, its class's and the common part."""
    own = process(rng, (n_cells, config.dimension), config.ell_m / CELL_M)
    patch = np.arange(n_cells) * CELL_M // config.alias_patch_m
    classes = rng.integers(config.n_alias, size=int(patch[-1]) + 1)
    faces = rng.standard_normal((config.n_alias, config.dimension))
    alias = _blur(
        faces[classes[patch.astype(np.int64)]],
        config.alias_blend_m / CELL_M,
        to_unit_variance=False,
    )
    everywhere = rng.standard_normal((1, config.dimension))
    share = 1.0 - config.alias - config.common
    return (
        np.sqrt(share) * own + np.sqrt(config.alias) * alias + np.sqrt(config.common) * everywhere
    )


def map_view(
    rng: np.random.Generator, field: np.ndarray, arc_m: np.ndarray, config: WorldConfig
) -> np.ndarray:
    """See a field from the given places in the map session's even light."""
    view = at(field, arc_m)
    return _descriptors(view + config.map_noise * rng.standard_normal(view.shape))


def query_view(
    rng: np.random.Generator, field: np.ndarray, arc_m: np.ndarray, config: WorldConfig
) -> np.ndarray:
    """See a field from about the given places, with noise that lasts and frames that fail."""
    n = len(arc_m)
    jitter_m = config.jitter_m * process(rng, (n, 1), config.jitter_frames)[:, 0]
    view = at(field, arc_m + jitter_m)
    level = np.exp(config.query_level_sd * process(rng, (n, 1), config.query_level_frames))
    noise = process(rng, view.shape, config.query_noise_frames)
    is_hard = rng.standard_normal((n, 1)) > config.hard_above
    hard = config.hard_noise * is_hard * rng.standard_normal(view.shape)
    return _descriptors(view + config.query_noise * level * noise + hard)


def _descriptors(view: np.ndarray) -> np.ndarray:
    unit = view / lengths(view)
    return (np.rint(unit * _DESCRIPTOR_GRID) / _DESCRIPTOR_GRID).astype(np.float32)


def _blur(values: np.ndarray, sigma: float, *, to_unit_variance: bool) -> np.ndarray:
    """Smooth periodic columns by a Gaussian; white noise of unit variance may keep its variance."""
    half = int(np.ceil(3.5 * sigma))
    taps = np.exp(-0.5 * (np.arange(half + 1) / max(sigma, 1e-9)) ** 2)
    total = taps**2 if to_unit_variance else taps
    scale = 2.0 * np.cumsum(total)[-1] - total[0]
    taps = taps / (np.sqrt(scale) if to_unit_variance else scale)
    n = len(values)
    padded = np.pad(values, ((half, half), (0, 0)), mode="wrap")
    out = taps[0] * values
    for k in range(1, half + 1):
        out += taps[k] * (padded[half - k : half - k + n] + padded[half + k : half + k + n])
    return out


def process(rng: np.random.Generator, shape: tuple[int, int], length: float) -> np.ndarray:
    """Draw periodic Gaussian processes of unit variance, one per column."""
    # White noise under a Gaussian of this width has the covariance exp(-d^2 / (2 length^2)).
    return _blur(rng.standard_normal(shape), length / np.sqrt(2.0), to_unit_variance=True)


def at(grid: np.ndarray, arc_m: np.ndarray) -> np.ndarray:
    """Interpolate the rows of a periodic grid linearly."""
    cell = np.floor(arc_m / CELL_M)
    share = (arc_m / CELL_M - cell)[:, None]
    low = cell.astype(np.int64) % len(grid)
    return (1.0 - share) * grid[low] + share * grid[(low + 1) % len(grid)]


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Give the length of every row, as a column."""
    return np.sqrt(np.sum(vectors**2, axis=1, keepdims=True))


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
