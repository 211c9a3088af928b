"""NUFR-KRI: thermal images of one route by day and by night, without poses."""

from pathlib import Path

import numpy as np

from taojax.datasets.folder import Session
from taojax.datasets.sessions import stamped_images
from taojax.datasets.trajectory import Trajectory
from taojax.errors import InputError
from taojax.specs import fail

__all__ = ["CAMERA", "VARIANT", "read_kri"]

CAMERA, VARIANT = "cam_3", "matlab_clahe2"

NOTE = "route progress, no metric poses: frames are spread evenly over"


def read_kri(
    folder: Path,
    *,
    camera: str = CAMERA,
    variant: str = VARIANT,
    route_m: float | None = None,
    n_rows: int | None = None,
) -> Session:
    """Read one sequence of NUFR-KRI as progress along its route.

    Args:
        folder: the sequence, with <camera>/<variant>/ below it; or that folder itself.
        camera: its camera.
        variant: how its images were prepared.
        route_m: length of the route [m]; it is the same for every sequence of it.
        n_rows: without a length, the route is so many rows long and the unit is a row; by default
            the frames of this sequence.

    Returns:
        All frames; x is index / (N - 1) times the route, y and theta are zero.

    Raises:
        InputError: there are no such images, or a name is no stamp.

    Source:
        Keil et al., 2024; the paper's route-progress protocol (Table 3).
    """
    if route_m is not None and not route_m > 0:
        raise InputError(f"a route of {route_m:g} m has no places; its length must be positive")
    if not folder.is_dir():
        raise fail(folder, "no such folder", "point at a sequence such as kri_day_2")
    images = folder / camera / variant
    if not images.is_dir() and any(folder.glob("*.png")):
        images = folder
    names, stamps = stamped_images(images, 19)
    length = (n_rows or len(names)) - 1 if route_m is None else route_m
    x = np.linspace(0.0, float(length), len(names))
    flat = np.zeros_like(x)
    unit = "rows" if route_m is None else "m"
    notes = [f"{NOTE} {length:g} {unit}"]
    unread = sorted(path.name for path in folder.glob("*.csv"))
    if unread:
        notes.append(f"{', '.join(unread)} was not read: what it holds is not confirmed")
    drive = Trajectory(stamps / 1e9, np.stack([x, flat, flat], axis=1))
    return Session(names, drive, False, tuple(notes))
