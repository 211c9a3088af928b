"""From two folders of images to a data folder, for `taojax audit --map-images`."""

import dataclasses
from pathlib import Path
from typing import Annotated, NamedTuple

from taojax.cli.common import flag, say
from taojax.cli.convert import motion_of, reading_of
from taojax.cli.convert_flags import Formats
from taojax.cli.describe import Describing, describe_folder, how_of
from taojax.errors import InputError, UsageError

__all__ = ["FOLDER", "FromImages", "Made", "are_asked", "make"]

NEEDED = ("map_images", "query_images", "map_poses", "odometry")

FOLDER = "taojax-images"
"""Beside a run: descriptors and data folders, each named by what it was made of."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Places:
    """Where the recordings lie."""

    map_images: Annotated[Path | None, flag("DIR", "DATASET is audited")] = None
    """Images of the map drive; with the next three in the place of DATASET. They are described as
    `taojax describe` does it and converted as `taojax convert` does it; both are kept in
    taojax-images/ beside the run."""

    query_images: Annotated[Path | None, flag("DIR", "none")] = None
    """Images of the query drive."""

    map_poses: Annotated[Path | None, flag("FILE", "none")] = None
    """Poses of the map (npy, CSV, TUM, KITTI, EuRoC, g2o): one row per image in the order of their
    names; or stamped at any rate, where images are named by UNIX time (s, ms, us or ns)."""

    odometry: Annotated[Path | None, flag("FILE", "none")] = None
    """Odometry of the query, in the same way."""

    truth: Annotated[Path | None, flag("FILE", "verdicts by the shipped calibration")] = None
    """True poses of the query, in the same way; read for the judge once the run is sealed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FromImages(Formats, Describing, Places):
    """Two folders of images in the place of DATASET."""


class Made(NamedTuple):
    """What an audit of images goes on with."""

    data: Path
    """Data folder without truth."""

    truth_csv: str | None
    """The true poses, to be written for the judge."""


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def are_asked(flags: FromImages) -> bool:
    """Tell whether images are to be audited.

    Raises:
        UsageError: some of the flags that this needs are missing, or flags contradict each other.
    """
    if flags == FromImages():
        return False
    if missing := [_flag(name) for name in NEEDED if getattr(flags, name) is None]:
        asked = next(f.name for f in dataclasses.fields(flags)
                     if getattr(flags, f.name) != f.default)  # fmt: skip
        raise UsageError(
            f"{_flag(asked)} audits images, which takes {', '.join(map(_flag, NEEDED))};"
            f" add {' and '.join(missing)}"
        )
    if not flags.gate_s > 0:
        raise UsageError(f"--gate-s {flags.gate_s} must be positive")
    how_of(flags)
    return True


def make(flags: FromImages, folder: Path, *, progress: bool) -> Made:
    """Describe and convert; what is there already, of the same files and flags, is kept.

    Args:
        flags: checked.
        folder: where intermediate files go.
        progress: draw bars.

    Raises:
        InputError: a file is missing or malformed, or does not fit the images.
        MissingExtraError: OpenCV, or for a model onnxruntime, is not installed.
    """
    for name in (*NEEDED, "truth", "times", "model"):
        path = getattr(flags, name)
        if path is not None and not path.exists():
            raise InputError(f"{path}: no such file or folder ({_flag(name)}); name another one")
    from taojax.datasets.convert import Choices, make_folder
    from taojax.datasets.edit import truth_text
    from taojax.datasets.from_images import (
        images_of,
        key_of,
        map_session,
        query_session,
        row_by_row,
    )
    from taojax.datasets.sessions import Matching

    map_images, query_images, map_poses, odometry = (getattr(flags, name) for name in NEEDED)
    motion, reading = motion_of(odometry, flags), reading_of(flags, is_motion=False)
    sides = images_of(map_images), images_of(query_images)
    # What is quickly refused is refused before images are described.
    mapped = map_session(sides[0], map_poses, reading, Matching(flags.gate_s))
    query = query_session(sides[1], motion)
    by = "GIST" if flags.model is None else flags.model.name
    more = (f"images are described by {by}",)
    more += () if query is not None else (row_by_row(sides[1], odometry),)
    mapped = dataclasses.replace(mapped, notes=(*mapped.notes, *more))

    views = tuple(
        _described(side, images.folder, folder, flags, progress=progress)
        for side, images in zip(("map", "query"), sides, strict=True)
    )
    said = [getattr(flags, field.name) for field in dataclasses.fields(Formats)]
    files = [map_poses, odometry, *views, *([flags.times] if flags.times else [])]
    data = folder / f"data-{key_of(said, files)}"
    if is_new := not data.exists():
        # Rows of descriptors follow the names of images, and so do rows of poses without times.
        choices = Choices(None, None, gate_s=flags.gate_s, motion=motion,
                          views=(views[0], views[1]), views_order="rows")  # fmt: skip
        make_folder(data, (mapped, query), choices)
    say(f"data folder: {data} ({'made' if is_new else 'kept, nothing changed'})")
    if flags.truth is None:
        return Made(data, None)
    text, notes = truth_text(data, flags.truth, reading, gate_s=flags.gate_s, offset_s=None)
    for note in notes:
        say(f"note: {note}")
    return Made(data, text)


def _described(side: str, images: Path, folder: Path, flags: FromImages, *, progress: bool) -> Path:
    """Return the descriptors of a folder, made now or before."""
    from taojax.datasets.from_images import key_of

    own = [getattr(flags, field.name) for field in dataclasses.fields(Describing)]
    places = [images] if flags.model is None else [images, flags.model]
    out = folder / f"{side}-{key_of(own, places)}.npy"
    if out.exists():
        say(f"{side} descriptors: {out} (kept, nothing changed)")
        return out
    # A recipe without its rows is of a run that was stopped just before the end.
    out.with_suffix(".toml").unlink(missing_ok=True)
    made = describe_folder(images, out, flags, progress=progress)
    say(f"{side} descriptors: {out} (made of {made.n_images:,} images, {made.kind}, in the order of"
        f" their {made.order})")  # fmt: skip
    return out
