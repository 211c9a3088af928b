"""The recordings on which the default calibration is fitted.

Of a real recording only the first half of the query frames, the calibration half, is ever handed
out. The maps of three recordings are drives of their own and are split once more; routes without
poses lose other stretches than in their benchmark; worlds are simulated with seeds of their own.
`family` names what must be left out together when the fit is tested on what it has not seen.

    for name, family, make in recipes(data):
        recording = make()
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.progress import R_IN_ROWS, R_OUT_ROWS
from benchmarks.progress import RECIPES as ROUTES
from benchmarks.sets import (
    ALIASES,
    COMMON,
    ROBOTCAR_MAP,
    ROBOTCAR_QUERIES,
    SEGMENTS_M,
    real,
)
from taojax.datasets.edit import delete_map_segments, kept_by_segments
from taojax.datasets.kidnap import read_poses
from taojax.datasets.progress import ProgressConfig, along, retained
from taojax.datasets.simulate import (
    WorldConfig,
    describe_routes,
    make_world,
    simulated_odometry,
)
from taojax.datasets.trajectory import motions
from taojax.files.specs import read_npy
from taojax.files.tables import MOTION, read_table, stacked
from taojax.runtime.retrieval import retrieve

REAL = {
    "mit_corridor": ("mit", (5.0, 10.0)),
    "intel_lab": ("intel", (1.5, 3.0)),
    "freiburg_campus": ("campus", (5.0, 10.0)),
    "tuc_corridor": ("tuc", (2.0, 4.0)),
    "tuc_corridor_mapout": ("tuc", (2.0, 4.0)),
    "radar_kaist01": ("radar", (5.0, 10.0)),
    "radar_dcc01": ("radar", (5.0, 10.0)),
    "radar_riverside01": ("radar", (5.0, 10.0)),
    "radar_oxford00": ("radar", (5.0, 10.0)),
}
"""Real recordings -> family; r_in, r_out [m]."""

RESPLIT = "mit_corridor", "intel_lab", "freiburg_campus"
"""Recordings whose map drive has poses and descriptors."""

MAP_SHARE = 0.45
"""Share of a map drive that is the map when it is split once more."""

LEAST_QUERIES = 150
"""A split with fewer queries is left out."""

RESPLIT_SCALE, RESPLIT_STEP, RESPLIT_YAW_RAD = 0.03, 0.03, np.deg2rad(0.5)
"""Odometry of such a split: scale error, white noise as a share of the step, yaw noise per step."""

PROGRESS_FAMILY = {"nordland_netvlad64": "nordland", "brisbane_event": "brisbane"}

DELETED: dict[str, tuple[tuple[float, float], ...]] = {
    "default": ProgressConfig().deleted,
    "mostly out": ((0.04, 0.21), (0.27, 0.45), (0.54, 0.71), (0.77, 0.95)),
    "none": (),
}
"""Stretches that a map without poses loses, as shares of the query drive."""

CUTS = "default", "h3", "h4"

KNOBS: tuple[dict[str, Any], ...] = (
    {"n_map": 1000, "n_query": 500},
    {"query_noise": 2.0, "map_noise": 0.7},
    {"odometry_scale": 0.06, "odometry_yaw_rad_per_m": 0.0015, "odometry_rad": 0.006},
    {"n_map": 1200, "n_query": 600, "driven_m": 4000.0, "loop_m": 3000.0},
    {"hard_above": 0.0, "hard_noise": 6.0, "query_level_sd": 0.4},
)
"""What makes a world another: frames farther apart, views that match worse, odometry that drifts,
a shorter road, many hard frames."""

OFF_MAP_M: tuple[tuple[tuple[float, float], ...], ...] = (
    ((300.0, 3300.0),),
    ((0.0, 2900.0),),
    ((500.0, 1500.0), (1700.0, 3900.0)),
)
"""Stretches of the map drive without which most of the query drive is off the map, metres."""

ROUTE_ALIAS = 0.45
"""Of the second views of real routes, whose places have `COMMON` in common."""

FIRST_SEED = 500
N_WORLDS = 20

DENSER = (
    "mit_corridor/half",
    "freiburg_campus/half",
    "tuc_corridor_mapout/half",
    "intel_lab/half",
    "radar_kaist01/half",
    "world/alias .45/502",
    "world/alias .25/516",
)
"""Recordings that are also there with frames `TIMES` as dense."""

TIMES = 4


class Recording(NamedTuple):
    """One map and one log with its truth, in memory."""

    name: str
    family: str
    """What is left out together."""

    map_poses: np.ndarray
    """(M, 3) x [m], y [m], theta [rad]."""

    odometry: np.ndarray
    """(T, 3) float32 forward [m], left [m], yaw [rad]."""

    index: np.ndarray  # pyright: ignore[reportIncompatibleMethodOverride]
    """(T, 100) int32 map rows, -1 = no candidate."""

    similarity: np.ndarray
    """(T, 100) float32."""

    map_descriptors: np.ndarray | None
    """(M, D); None where the recording came with retrieval lists."""

    truth_m: np.ndarray
    """(T, 2) true positions."""

    r_in_m: float
    r_out_m: float


class Recipe(NamedTuple):
    """A recording that is made when its turn comes."""

    name: str
    family: str
    make: Callable[[], Recording]


def _described(
    names: tuple[str, str],
    log: tuple[np.ndarray, np.ndarray, np.ndarray],
    descriptors: tuple[np.ndarray, np.ndarray],
    radii: tuple[float, float],
) -> Recording:
    """Complete a recording whose map and query images have descriptors.

    Args:
        names: of the recording and of its family.
        log: (M, 3) map poses [m, m, rad], (T, 3) odometry [m, m, rad], (T, 2) truth [m].
        descriptors: (M, D) of the map, (T, D) of the queries.
        radii: r_in, r_out [m].
    """
    map_poses, odometry, truth_m = log
    index, similarity = retrieve(*descriptors)
    return Recording(
        *names,
        map_poses,
        odometry.astype(np.float32),
        index,
        similarity,
        np.asarray(descriptors[0]),
        truth_m,
        *radii,
    )


def first_half(folder: Path, name: str) -> Recording:
    """Load the calibration half of a real recording, `T // 2` query frames."""
    family, radii = REAL[folder.name]
    whole = real(folder, radii)
    half = slice(len(whole.odometry) // 2)
    return Recording(
        name,
        family,
        whole.map_poses,
        whole.odometry[half],
        whole.index[half],
        whole.similarity[half],
        whole.map_descriptors,
        whole.truth_m[half],
        *radii,
    )


def resplit(folder: Path, name: str, *, is_reversed: bool, seed: int) -> Recording:
    """Split the map drive of a real recording into a map and a query drive.

    Args:
        folder: of the recording, with map poses and map descriptors.
        name: of the result.
        is_reversed: the last frames are the map and the first ones the query drive.
        seed: of the noise on the (T, 3) motions between the map poses.
    """
    family, radii = REAL[folder.name]
    poses = read_poses(folder / "map/poses.csv", "map_poses")[:, 1:]
    views = np.asarray(read_npy(folder / "map/descriptors.npy", "descriptors"))
    n_map = round(MAP_SHARE * len(poses))
    mapped, driven = slice(n_map), slice(n_map, None)
    if is_reversed:
        mapped, driven = slice(len(poses) - n_map, None), slice(len(poses) - n_map)
    rng = np.random.default_rng(seed)
    odometry = motions(poses[driven])
    step_m = np.hypot(odometry[:, :1], odometry[:, 1:2])
    odometry[:, :2] *= 1.0 + RESPLIT_SCALE
    odometry[:, :2] += RESPLIT_STEP * step_m * rng.standard_normal((len(odometry), 2))
    odometry[1:, 2] += RESPLIT_YAW_RAD * rng.standard_normal(len(odometry) - 1)
    log = poses[mapped], odometry, poses[driven, :2]
    return _described((name, family), log, (views[mapped], views[driven]), radii)


def route_half(folder: Path, name: str, route_name: str, deleted: str, seed: int) -> Recording:
    """Drive the first half of a route of which only the progress is known; a metre is a row.

    Args:
        folder: of the two drives.
        name: of the result.
        route_name: of its recipe in the progress benchmark.
        deleted: which stretches the map loses.
        seed: of the (T, 3) simulated odometry.
    """
    route = next(recipe for recipe in ROUTES if recipe.name == route_name).make(folder)
    config = ProgressConfig(deleted=DELETED[deleted])
    kept, half = retained(route, config), slice(len(route.query_rows) // 2)
    map_rows, query_rows = route.map_rows[kept], route.query_rows[half]
    map_poses = np.stack([map_rows, np.zeros_like(map_rows), np.zeros_like(map_rows)], axis=1)
    truth_m = np.stack([query_rows, np.zeros_like(query_rows)], axis=1)
    log = map_poses, along(query_rows, config, seed), truth_m
    views = np.asarray(route.map_views[kept]), np.asarray(route.query_views[half])
    names = name, PROGRESS_FAMILY[folder.name]
    return _described(names, log, views, (R_IN_ROWS, R_OUT_ROWS))


def kaist(folder: Path, name: str, cut: str, config: WorldConfig, seed: int) -> Recording:
    """Drive two real sessions with simulated views and odometry.

    Args:
        folder: of the routes.
        name: of the result.
        cut: scenario whose map segments are deleted.
        config: of appearance and noise.
        seed: of both.
    """
    map_poses = read_poses(folder / "map/poses.csv", "map_poses")
    query = read_poses(folder / "truth/query_poses.csv", "query_poses")
    views = describe_routes(map_poses, query, config, seed)
    stays = kept_by_segments(map_poses[:, 1:3], SEGMENTS_M[cut])
    odometry = simulated_odometry(query[:, 1:], config, seed)
    log = map_poses[stays, 1:], odometry, query[:, 1:3]
    return _described((name, "kaist_routes"), log, (views[0][stays], views[1]), (10.0, 10.0))


def robotcar(folder: Path, name: str, traverse: str, config: WorldConfig, seed: int) -> Recording:
    """Drive two real traverses with real visual odometry and simulated views.

    Args:
        folder: of the traverses.
        name: of the result.
        traverse: the query drive.
        config: of appearance and its noise.
        seed: of both.
    """
    map_poses = read_poses(folder / ROBOTCAR_MAP / "poses.csv", "map_poses")
    query = read_poses(folder / traverse / "poses.csv", "query_poses")
    odometry = stacked(read_table(folder / traverse / "odometry.csv", "query_odometry"), MOTION)
    views = describe_routes(map_poses, query, config, seed)
    log = map_poses[:, 1:], odometry, query[:, 1:3]
    return _described((name, "robotcar"), log, views, (10.0, 20.0))


def world(
    name: str, config: WorldConfig, segments_m: tuple[tuple[float, float], ...], seed: int
) -> Recording:
    """Simulate a world whose map lacks stretches.

    Args:
        name: of the result.
        config: knobs of the world.
        segments_m: (start, end) of the stretches [m] along the map drive.
        seed: of the world.
    """
    made = delete_map_segments(make_world(config, seed), segments_m)
    log = made.map_poses[:, 1:], made.odometry[:, 1:], made.query_poses[:, 1:3]
    views = made.map_descriptors, made.query_descriptors
    return _described((name, "world"), log, views, (10.0, 10.0))


def parts_of(odometry: np.ndarray, times: int) -> np.ndarray:
    """Return the (T, 3) motion [m, m, rad] that, made `times` times, is the given (T, 3) one."""
    yaw = odometry[:, 2].astype(np.float64)
    forward, left = odometry[:, 0].astype(np.float64), odometry[:, 1].astype(np.float64)
    # Logarithm and exponential of SE(2): along an arc by (u, v) [m] and yaw, the displacement is
    # (s u - c v, c u + s v) with s = sin(yaw) / yaw and c = (1 - cos(yaw)) / yaw.
    s, c = _arc(yaw)
    square = s * s + c * c
    u, v = (s * forward + c * left) / square, (s * left - c * forward) / square
    s, c = _arc(yaw / times)
    return np.stack([s * u - c * v, c * u + s * v, yaw], axis=1) / times


def _arc(yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sin(yaw) / yaw and (1 - cos(yaw)) / yaw of (T,) angles [rad]."""
    half = np.sinc(yaw / (2.0 * np.pi))
    return np.sinc(yaw / np.pi), 0.5 * yaw * half * half


def denser(recording: Recording, times: int = TIMES) -> Recording:
    """Put `times - 1` frames into every step; each sees what the frame ahead of it sees.

    Args:
        recording: of T frames.
        times: equal parts of every step.

    Returns:
        The recording with `1 + (T - 1) * times` frames; frame i of T is frame `i * times`.
    """
    n = len(recording.odometry)
    ends = np.concatenate([[0], np.repeat(np.arange(1, n), times)])
    odometry = parts_of(recording.odometry, times)[ends]
    odometry[0] = recording.odometry[0]
    at, frames = np.arange(len(ends)) / times, np.arange(n)
    x_m, y_m = (np.interp(at, frames, recording.truth_m[:, axis]) for axis in range(2))
    return recording._replace(
        name=f"{recording.name} x{times}",
        odometry=odometry.astype(np.float32),
        index=recording.index[ends],
        similarity=recording.similarity[ends],
        truth_m=np.stack([x_m, y_m], axis=1),
    )


def _densely(make: Callable[[], Recording]) -> Recording:
    return denser(make())


def recipes(data: Path) -> list[tuple[str, str, Callable[[], Recording]]]:
    """List name, family and maker of every recording; real ones that are absent are left out.

    Args:
        data: folder of the real recordings.
    """
    found = [*_real(data), *_progress(data), *_routes(data), *_worlds()]
    by_name = {recipe.name: recipe for recipe in found}
    for name in DENSER:
        if base := by_name.get(name):
            make = partial(_densely, base.make)
            found.append(Recipe(f"{name} x{TIMES}", base.family, make))
    return list(found)


def _real(data: Path) -> list[Recipe]:
    """List the first halves and the map drives split once more."""
    there = [folder for folder in REAL if (data / folder).is_dir()]
    found = []
    for folder in there:
        name = f"{folder}/half"
        found.append(Recipe(name, REAL[folder][0], partial(first_half, data / folder, name)))
    for seed, folder in enumerate(RESPLIT, FIRST_SEED):
        if folder not in there:
            continue
        n_frames = len(read_poses(data / folder / "map/poses.csv", "map_poses"))
        if n_frames - round(MAP_SHARE * n_frames) < LEAST_QUERIES:
            continue
        for suffix, is_reversed in (("", False), (" reversed", True)):
            name = f"{folder}/map resplit{suffix}"
            make = partial(resplit, data / folder, name, is_reversed=is_reversed, seed=seed)
            found.append(Recipe(name, REAL[folder][0], make))
    return found


def _progress(data: Path) -> list[Recipe]:
    """List the routes without poses, each with several maps."""
    found = []
    for route in ROUTES:
        if route.folder not in PROGRESS_FAMILY or not (data / route.folder).is_dir():
            continue
        for seed, deleted in enumerate(DELETED, FIRST_SEED):
            name = f"{route.name}/{deleted} deleted"
            make = partial(route_half, data / route.folder, name, route.name, deleted, seed)
            found.append(Recipe(name, PROGRESS_FAMILY[route.folder], make))
    return found


def _routes(data: Path) -> list[Recipe]:
    """List real routes with simulated views, plainly and with other shares in common."""
    found = []
    other = WorldConfig(alias=ROUTE_ALIAS, common=COMMON)
    for suffix, config in (("", WorldConfig()), (f" alias {_short(ROUTE_ALIAS)}", other)):
        if (folder := data / "kaist_routes").is_dir():
            for cut in ("default", "h3"):
                for seed in range(2):
                    name = f"kaist_routes/{cut}/{seed}{suffix}"
                    make = partial(kaist, folder, name, cut, config, seed)
                    found.append(Recipe(name, "kaist_routes", make))
        if (folder := data / "robotcar_vo").is_dir():
            for traverse in ROBOTCAR_QUERIES:
                name = f"robotcar_vo/{traverse[:10]}{suffix}"
                make = partial(robotcar, folder, name, traverse, config, FIRST_SEED)
                found.append(Recipe(name, "robotcar", make))
    return found


def _worlds() -> list[Recipe]:
    """List simulated worlds: every alias with the usual knobs first, then with others."""
    found = []
    for k in range(N_WORLDS):
        alias = ALIASES[k % len(ALIASES)]
        n_plain, seed = len(ALIASES), FIRST_SEED + k
        knobs = {} if k < n_plain else KNOBS[(k + k // n_plain) % len(KNOBS)]
        config = WorldConfig(alias=alias, common=COMMON, **(knobs | _cap(k)))
        name = f"world/alias {_short(alias)}/{seed}"
        segments_m = SEGMENTS_M[CUTS[k % len(CUTS)]]
        found.append(Recipe(name, "world", partial(world, name, config, segments_m, seed)))
    for k, segments_m in enumerate(OFF_MAP_M, N_WORLDS):
        alias = ALIASES[(2 * k) % len(ALIASES)]
        config, seed = WorldConfig(alias=alias, common=COMMON, **_cap(k)), FIRST_SEED + k
        name = f"world/off map, alias {_short(alias)}/{seed}"
        found.append(Recipe(name, "world", partial(world, name, config, segments_m, seed)))
    return found


def _cap(k: int) -> dict[str, Any]:
    """Bring the sessions nearer together [m] in every second world."""
    return {} if k % 2 else {"offset_cap_m": 4.0}


def _short(share: float) -> str:
    return f"{share:g}".removeprefix("0")
