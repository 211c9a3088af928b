"""Data folders: names of their descriptors, and what one says of itself (about.toml)."""

import tomllib
from pathlib import Path
from typing import NamedTuple

from taojax.files.specs import fail, read_text

DESCRIPTORS = (
    ("map/descriptors.npy", "query/descriptors.npy"),
    # As VPR-methods-evaluation writes them.
    ("database_descriptors.npy", "queries_descriptors.npy"),
)
"""The names that map and query descriptors may have in a data folder; one pair is there."""


class About(NamedTuple):
    """Facts that the report repeats, and how a log is cut."""

    notes: tuple[str, ...] = ()
    """Sentences, such as: simulated descriptors."""

    trial_frames: int | None = None
    """The log is a row of trials of so many frames, each with a fresh start; None = one log."""

    own_gap_m: float | None = None
    """The drive is its own map: a frame knows those that lie so much way behind it, metres;
    None = the map is another drive."""


def read_about(folder: Path, n_query: int | None = None) -> About:
    """Read about.toml; a folder without one says nothing.

    Args:
        folder: a data folder.
        n_query: frames of the log, which trials must divide; None where they do not matter.

    Raises:
        InputError: the file is not TOML, or an entry is not what it should be.
    """
    path = folder / "about.toml"
    if not path.exists():
        return About()
    try:
        about = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise fail(path, f"is not TOML ({error})", "expected notes = [...]") from error
    notes, frames = about.get("notes", []), about.get("trial_frames")
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        raise fail(path, "notes is not a list of sentences", "expected notes = [...]")
    gap_m = about.get("own_gap_m")
    if gap_m is not None:
        if type(gap_m) not in (int, float) or not gap_m > 0 or frames is not None:
            what = f"own_gap_m is {gap_m!r}"
            fix = "expected metres of way, more than 0, in a folder without trial_frames"
            raise fail(path, what, fix)
        return About(tuple(notes), own_gap_m=float(gap_m))
    if frames is None:
        return About(tuple(notes))
    if type(frames) is not int or frames < 1 or (n_query or frames) % frames:
        log = "log" if n_query is None else f"{n_query} rows of query/odometry.csv"
        what = f"trial_frames is {frames!r}"
        raise fail(path, what, f"expected a whole number, at least 1, that divides the {log}")
    return About(tuple(notes), frames)
