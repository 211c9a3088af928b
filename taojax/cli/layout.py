"""What a data folder must hold, looked up before anything heavy is imported."""

from pathlib import Path
from shlex import quote

from taojax.errors import InputError

__all__ = ["advice", "check_drive", "check_folder", "check_layout", "missing"]

TRUTH = "truth/query_poses.csv"
LISTS = "query/retrievals.npz"

N_LISTED = 4
"""Files of a folder that a message names."""


def check_layout(folder: Path, *, has_truth: bool) -> None:
    """Refuse what cannot be a data folder, all that is missing at once.

    Args:
        folder: laid out as data_specs/README.md says.
        has_truth: whether the true poses are needed too.

    Raises:
        InputError: no such folder, or files are missing.
    """
    check_folder(folder)
    sensors = missing(folder)
    lacks = [*sensors, *([TRUTH] if has_truth and not (folder / TRUTH).exists() else [])]
    if sensors:
        raise InputError(f"{folder}: lacks {_listed(lacks)}; {advice(folder)}")
    if lacks:
        fix = "add it, or run `taojax score` without truth"
        raise InputError(f"{folder / TRUTH}: no such file; {fix}")


def check_drive(folder: Path) -> None:
    """Refuse what cannot be one drive with its truth.

    Args:
        folder: to be audited as one drive that closes on itself.

    Raises:
        InputError: no such folder, or files are missing.
    """
    check_folder(folder)
    for name in ("query/odometry.csv", TRUTH):
        if not (folder / name).exists():
            fix = "a drive that closes on itself is audited with its odometry and its true poses"
            raise InputError(f"{folder / name}: no such file; {fix}")


def check_folder(folder: Path) -> None:
    """Refuse what is no folder.

    Raises:
        InputError: it is not there, or is a file.
    """
    if folder.exists() and not folder.is_dir():
        fix = "name the folder, or make one of single files with `taojax convert files`"
        raise InputError(f"{folder}: is a file, no data folder; {fix}")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such data folder; see data_specs/README.md for the layout")


def missing(folder: Path) -> list[str]:
    """Return what a data folder lacks to be scored."""
    from taojax.files.dataset_info import DESCRIPTORS

    lacks = [name for name in ("map/poses.csv", "query/odometry.csv")
             if not (folder / name).exists()]  # fmt: skip
    there = [[(folder / name).exists() for name in pair] for pair in DESCRIPTORS]
    if (folder / LISTS).exists() or any(all(pair) for pair in there):
        return lacks
    for pair, is_there in zip(DESCRIPTORS, there, strict=True):
        if any(is_there):
            return [*lacks, pair[is_there.index(False)]]
    return [*lacks, f"{' with '.join(DESCRIPTORS[0])} (or {LISTS})"]


def advice(folder: Path) -> str:
    """Return the command that makes a data folder of what lies in a folder instead."""
    name = quote(str(folder))
    if (folder / "poses.csv").is_file():
        return f"this is one drive: taojax convert folder {name} OUT --map FOLDER_OF_THE_MAP"
    has_poses = any((folder / name).is_file() for name in (TRUTH, "query/poses.csv"))
    if (folder / "map/poses.csv").is_file() and has_poses:
        command = f"taojax convert folder {name} OUT --simulate-descriptors"
        return f"`{command}` simulates what is missing"
    return f"{holds(folder)}; `taojax convert files` takes files of any name"


def holds(folder: Path) -> str:
    """Say in a few words what lies in a folder."""
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    names = [f"{path.name}/" if path.is_dir() else path.name for path in inside[:N_LISTED]]
    more = f" and {len(inside) - N_LISTED:,} more" if len(inside) > N_LISTED else ""
    return f"it holds {', '.join(names) or 'nothing'}{more}"


def _listed(names: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
