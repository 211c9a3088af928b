"""Half-written files and folders: hidden beside the place they go to, locked by their writer.

The system takes the lock from a process that dies, whatever killed it: what has none is litter.
"""

import contextlib
import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def locked_part(path: Path, *, is_folder: bool) -> Iterator[Path]:
    """Make a hidden part beside a path; renamed by the caller, or removed at the end.

    Parts of the same path that dead processes left are cleared first; those of living ones stay.

    Args:
        path: where the part goes once it is whole.
        is_folder: make a folder instead of an empty file.

    Raises:
        OSError: read-only, full, no such folder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    clear_dead(path)
    part, lock = _claim(path, is_folder=is_folder)
    try:
        yield part
    finally:
        _remove(part)
        os.close(lock)


def clear_dead(path: Path) -> None:
    """Remove the parts of a path whose writers are dead.

    Where the file system knows no locks, nobody can tell, and nothing is removed.
    """
    own = re.compile(re.escape(f".{path.name}.") + r"[0-9a-f]{12}\.part")
    with contextlib.suppress(OSError):
        for name in filter(own.fullmatch, os.listdir(path.parent)):
            _clear(path.with_name(name))


def _clear(part: Path) -> None:
    with contextlib.suppress(OSError):
        lock = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _remove(part)
        finally:
            os.close(lock)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _claim(path: Path, *, is_folder: bool) -> tuple[Path, int]:
    """Return a new part and the open file that holds its lock."""
    while True:
        part = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
        part.mkdir() if is_folder else part.touch(exist_ok=False)
        with contextlib.suppress(FileNotFoundError):
            lock = os.open(part, os.O_RDONLY)
            with contextlib.suppress(OSError):
                fcntl.flock(lock, fcntl.LOCK_EX)
            # Before it was locked, somebody may have taken it for litter.
            if part.exists():
                return part, lock
            os.close(lock)
