"""The data sets of the leaderboard: simulated worlds, real routes, real recordings."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taojax.audit.labels import read_truth
from taojax.datasets.edit import SCENARIO_SEGMENTS_M as SEGMENTS_M
from taojax.datasets.edit import kept_by_segments, scenario
from taojax.datasets.kidnap import read_poses
from taojax.datasets.simulate import (
    WorldConfig,
    describe_routes,
    make_world,
    seen_places,
    simulated_odometry,
)
from taojax.files.tables import MOTION, read_table, stacked
from taojax.runtime.observations import load_observations
from taojax.runtime.retrieval import dense, retrieve
from taojax.runtime.rivals import dense_lists
from taojax.runtime.score import candidates

REAL = {
    "mit_corridor": (5.0, 10.0),
    "freiburg_campus": (5.0, 10.0),
    "intel_lab": (1.5, 3.0),
    "tuc_corridor_mapout": (2.0, 4.0),
    "radar_kaist01": (5.0, 10.0),
    "radar_dcc01": (5.0, 10.0),
    "radar_riverside01": (5.0, 10.0),
    "radar_oxford00": (5.0, 10.0),
}
"""Real recordings -> r_in, r_out [m]."""

ALIASES = (0.05, 0.25, 0.45, 0.6, 0.7)
"""Share of appearance that a place has in common with its class, from "the level of similarity
separates" to "everything aliases"; another `COMMON` is shared by all places."""

COMMON = 0.2

ROBOTCAR_MAP = "2014_07_14_14_49_50"
ROBOTCAR_QUERIES = "2015_05_19_14_06_38", "2015_08_13_16_02_58"


@dataclass(frozen=True)
class DataSet:
    """One map and one log with its truth, in memory."""

    name: str
    column: str
    """Column of the leaderboard; sets of one column are averaged."""

    kind: str
    """What is real and what is simulated."""

    map_poses: np.ndarray
    """(M, 3) x [m], y [m], theta [rad]."""

    odometry: np.ndarray
    """(T, 3) float32 forward [m], left [m], yaw [rad]."""

    index: np.ndarray
    """(T, 100) map rows, -1 = no candidate."""

    similarity: np.ndarray
    """(T, 100) float32."""

    rows: np.ndarray
    """(T, M) float32 dense similarity; 0 where a retrieval list has no candidate."""

    map_descriptors: np.ndarray | None
    truth_m: np.ndarray
    """(T, 2) true positions."""

    seen_m: np.ndarray
    """(T, 2) where in the map the appearance of a frame belongs: the truth, less the offset
    between sessions where the simulation knows it. Only an oracle sees it."""

    r_in_m: float
    r_out_m: float


class Recipe(NamedTuple):
    """A data set that is made when its turn comes."""

    name: str
    make: Callable[[], DataSet]


class _Log(NamedTuple):
    """What every source of data has to deliver."""

    map_poses: np.ndarray
    odometry: np.ndarray
    truth_m: np.ndarray
    seen_m: np.ndarray


def _described(
    names: tuple[str, str, str],
    log: _Log,
    descriptors: tuple[np.ndarray, np.ndarray],
    radii: tuple[float, float],
) -> DataSet:
    """Complete a set whose map and query images have descriptors."""
    index, similarity = retrieve(*descriptors)
    return DataSet(
        *names,
        map_poses=log.map_poses,
        odometry=log.odometry.astype(np.float32),
        index=index,
        similarity=similarity,
        rows=dense(*descriptors),
        map_descriptors=np.asarray(descriptors[0]),
        truth_m=log.truth_m,
        seen_m=log.seen_m,
        r_in_m=radii[0],
        r_out_m=radii[1],
    )


def simulated(config: WorldConfig, seed: int, cut: str, *, name: str, column: str) -> DataSet:
    """Simulate a world and delete the map segments of a scenario.

    Args:
        config: knobs of the world.
        seed: of the world.
        cut: name of the scenario.
        name: of the set.
        column: of the leaderboard.
    """
    world = scenario(make_world(config, seed), cut)
    log = _Log(
        map_poses=world.map_poses[:, 1:],
        odometry=world.odometry[:, 1:],
        truth_m=world.query_poses[:, 1:3],
        seen_m=seen_places(config, seed),
    )
    descriptors = world.map_descriptors, world.query_descriptors
    return _described((name, column, "simulated"), log, descriptors, (10.0, 10.0))


def kaist_route(folder: Path, cut: str, seed: int) -> DataSet:
    """Drive two real sessions; descriptors and odometry noise are simulated."""
    config = WorldConfig()
    map_poses = read_poses(folder / "map/poses.csv", "map_poses")
    query = read_poses(folder / "truth/query_poses.csv", "query_poses")
    seen = describe_routes(map_poses, query, config, seed)
    stays = kept_by_segments(map_poses[:, 1:3], SEGMENTS_M[cut])
    odometry = simulated_odometry(query[:, 1:], config, seed)
    log = _Log(map_poses[stays, 1:], odometry, query[:, 1:3], query[:, 1:3])
    names = (
        f"kaist_routes/{cut}/{seed}",
        "kaist_routes",
        "real routes, simulated odometry and views",
    )
    return _described(names, log, (seen[0][stays], seen[1]), (10.0, 10.0))


def robotcar_route(folder: Path, traverse: str, seed: int) -> DataSet:
    """Drive two real traverses with real visual odometry; descriptors are simulated."""
    map_poses = read_poses(folder / ROBOTCAR_MAP / "poses.csv", "map_poses")
    query = read_poses(folder / traverse / "poses.csv", "query_poses")
    table = read_table(folder / traverse / "odometry.csv", "query_odometry")
    odometry = stacked(table, MOTION)
    log = _Log(map_poses[:, 1:], odometry, query[:, 1:3], query[:, 1:3])
    names = (
        f"robotcar_vo/{traverse[:10]}",
        "robotcar_vo",
        "real routes and odometry, simulated views",
    )
    return _described(
        names, log, describe_routes(map_poses, query, WorldConfig(), seed), (10.0, 20.0)
    )


def real(folder: Path, radii: tuple[float, float]) -> DataSet:
    """Load a real recording."""
    seen = load_observations(folder)
    truth = read_truth(folder / "truth", len(seen.t_s)).xy_m
    map_poses = seen.map_xyt
    names = folder.name, folder.name, "real"
    if seen.descriptors is not None:
        log = _Log(map_poses, seen.odometry, truth, truth)
        return _described(names, log, seen.descriptors, radii)
    index, similarity = candidates(seen)
    return DataSet(
        *names,
        map_poses,
        seen.odometry,
        index,
        similarity,
        dense_lists(index, similarity, len(map_poses)),
        None,
        truth,
        truth,
        *radii,
    )


def recipes(data: Path, *, quick: bool, only: str = "") -> list[Recipe]:
    """List the data sets, real ones first; what is absent is said and left out.

    Args:
        data: folder of the real recordings.
        quick: fewer seeds, routes and steps of the range.
        only: part of a name; the others are left out.
    """
    found = []
    for name, radii in REAL.items():
        found.append(Recipe(name, partial(real, data / name, radii)))
    for cut in ("default",) if quick else ("default", "h3", "h4"):
        route = partial(kaist_route, data / "kaist_routes", cut, 0)
        found.append(Recipe(f"kaist_routes/{cut}/0", route))
    for traverse in ROBOTCAR_QUERIES[: 1 if quick else None]:
        route = partial(robotcar_route, data / "robotcar_vo", traverse, 0)
        found.append(Recipe(f"robotcar_vo/{traverse[:10]}", route))
    kept = [recipe for recipe in found if (data / recipe.name.split("/")[0]).is_dir()]
    for absent in sorted(
        {r.name.split("/")[0] for r in found} - {r.name.split("/")[0] for r in kept}
    ):
        print(f"skipped {absent}: not found in {data} (real recordings are not in this repository)")
    seeds = range(2 if quick else 5)
    for cut in ("default", "h3", "h4"):
        for seed in seeds:
            name = f"simulated/{cut}/{seed}"
            make = partial(
                simulated, WorldConfig(), seed, cut, name=name, column=f"simulated {cut}"
            )
            kept.append(Recipe(name, make))
    for alias in ALIASES[:: 2 if quick else 1]:
        config = WorldConfig(alias=alias, common=COMMON)
        for seed in range(100, 101 if quick else 103):
            name, column = f"range/alias {alias:g}/{seed}", f"simulated alias {alias:g}"
            make = partial(simulated, config, seed, "default", name=name, column=column)
            kept.append(Recipe(name, make))
    return [recipe for recipe in kept if only in recipe.name]
