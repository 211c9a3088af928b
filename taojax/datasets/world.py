"""What a simulated world consists of, and how it becomes a data folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from taojax.errors import ConfigError, InputError

__all__ = ["DECIMALS", "World", "WorldConfig", "write_world"]

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
