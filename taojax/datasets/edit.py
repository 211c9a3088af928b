"""Deletes stretches of a map, so that queries there truly have no answer.

The ranges of the three map-out scenarios are metres along the map session's own drive. The session
passes some places twice; a deleted stretch goes on every pass, together with everything within a
clearance of it.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from taojax.datasets.world import World
from taojax.errors import InputError

__all__ = ["SCENARIOS", "delete_from_folder", "delete_map_segments", "kept_by_segments", "scenario"]

Segments = Sequence[tuple[float, float]]

CLEARANCE_M = 20.0
"""A query within 10 m of a deleted stretch is then more than 10 m from every frame that stays."""

SCENARIO_SEGMENTS_M: dict[str, tuple[tuple[float, float], ...]] = {
    "full": (),
    # Four short gaps, two of them on road that is driven twice.
    "default": ((200.0, 395.0), (1040.0, 1235.0), (2450.0, 2650.0), (2960.0, 3160.0)),
    # Two long gaps, each driven once: one in the first half of the queries, one in the second.
    "h3": ((1900.0, 2567.0), (2900.0, 3567.0)),
    # One long gap that is driven twice.
    "h4": ((180.0, 875.0),),
}
SCENARIOS = tuple(SCENARIO_SEGMENTS_M)
"""Names of the scenarios; `full` deletes nothing."""


def kept_by_segments(
    map_xy_m: Float[np.ndarray, "m 2"], segments: Segments, clearance_m: float = CLEARANCE_M
) -> Bool[np.ndarray, " m"]:
    """Tell which map frames stay when stretches of the drive are deleted.

    Args:
        map_xy_m: positions of the map frames in the order driven.
        segments: (start, end) in metres driven since the first map frame.
        clearance_m: frames this near to a deleted one, on any pass, are deleted too.

    Returns:
        True for the frames that stay.

    Raises:
        InputError: if a range is empty of map frames or no frame stays.
    """
    steps = np.diff(map_xy_m, axis=0)
    driven_m = np.concatenate([[0.0], np.cumsum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2))])
    stays = np.ones(len(map_xy_m), dtype=bool)
    for start_m, end_m in segments:
        within = (driven_m >= start_m) & (driven_m <= end_m)
        if not within.any():
            raise InputError(
                f"no map frame between {start_m:g} m and {end_m:g} m: the map is driven "
                f"{driven_m[-1]:.0f} m; choose a range inside it"
            )
        for center in map_xy_m[within]:
            away = map_xy_m - center[None, :]
            stays &= away[:, 0] ** 2 + away[:, 1] ** 2 > clearance_m**2
    if not stays.any():
        raise InputError("the segments delete the whole map: choose shorter ones")
    return stays


def delete_map_segments(
    world: World, segments: Segments, clearance_m: float = CLEARANCE_M
) -> World:
    """Delete stretches of a world's map on every pass.

    Args:
        world: the world; it stays as it is.
        segments: (start, end) in metres driven since the first map frame.
        clearance_m: frames this near to a deleted one are deleted too.

    Returns:
        A world whose map lacks those frames.

    Raises:
        InputError: if a range is empty of map frames or no frame stays.
    """
    stays = kept_by_segments(world.map_poses[:, 1:3], segments, clearance_m)
    return replace(
        world, map_poses=world.map_poses[stays], map_descriptors=world.map_descriptors[stays]
    )


def scenario(world: World, name: str) -> World:
    """Apply one of the named map-out scenarios.

    Args:
        world: a world with its full map.
        name: one of `SCENARIOS`.

    Returns:
        The world with the scenario's map.

    Raises:
        InputError: if there is no such scenario or the map is too short for it.
    """
    if name not in SCENARIO_SEGMENTS_M:
        raise InputError(f"no scenario {name!r}: choose one of {', '.join(SCENARIOS)}")
    return delete_map_segments(world, SCENARIO_SEGMENTS_M[name])


def delete_from_folder(source: Path, destination: Path, segments: Segments) -> None:
    """Write a copy of a data folder whose map lacks stretches.

    Args:
        source: a data folder with descriptors or with retrieval lists; it stays as it is.
        destination: the new folder.
        segments: (start, end) in metres driven since the first map frame.

    Raises:
        InputError: if the destination exists, a range is empty of map frames or no frame stays.
    """
    if destination.exists():
        raise InputError(f"{destination} exists: choose a new folder")
    header, *rows = (source / "map" / "poses.csv").read_text(encoding="utf-8").splitlines()
    rows = [row for row in rows if row.strip()]
    poses = np.array([row.split(",") for row in rows], dtype=np.float64)
    stays = kept_by_segments(poses[:, 1:3], segments)

    shutil.copytree(source, destination)
    kept_rows = [row for row, stay in zip(rows, stays, strict=True) if stay]
    with open(destination / "map" / "poses.csv", "w", newline="\n", encoding="utf-8") as file:
        file.write("\n".join([header, *kept_rows]) + "\n")
    descriptors = Path("map", "descriptors.npy")
    if (source / descriptors).exists():
        np.save(destination / descriptors, np.load(source / descriptors)[stays])
    retrievals = Path("query", "retrievals.npz")
    if (source / retrievals).exists():
        _renumber(source / retrievals, destination / retrievals, stays)


def _renumber(source: Path, destination: Path, stays: np.ndarray) -> None:
    """Rewrite retrieval lists for a shorter map, deleted candidates dropped."""
    with np.load(source) as lists:
        index, similarity = lists["index"], lists["similarity"]
    # The last entry answers for index -1, no candidate.
    number = np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1)
    index = number[index].astype(np.int32)
    similarity = np.where(index >= 0, similarity, 0.0).astype(np.float32)
    # A stable sort moves the gaps to the end and keeps best first.
    order = np.argsort(index < 0, axis=1, kind="stable")
    np.savez(
        destination,
        index=np.take_along_axis(index, order, axis=1),
        similarity=np.take_along_axis(similarity, order, axis=1),
    )
