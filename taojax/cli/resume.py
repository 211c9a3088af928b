"""A command that was stopped and is repeated goes on: whole sealed runs are not made again."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from taojax.errors import InputError

if TYPE_CHECKING:
    from taojax.config import Config

BEGUN = ".begun"
"""In a folder of several runs until all of them are judged: the command that fills it."""


def is_sealed(run: Path, dataset: Path, config: "Config") -> bool:
    """Tell whether a folder holds just the run that this data, settings and code would make.

    Args:
        run: perhaps a sealed run.
        dataset: a data folder.
        config: settings.
    """
    from taojax.config import to_toml
    from taojax.files.records import code_digest, digest_file, input_hashes, read_run

    if not (run / "manifest.json").is_file():
        return False
    try:
        sealed = read_run(run)
        hashes = input_hashes(sealed.manifest)
        same_data = all(digest_file(dataset / name) == value for name, value in hashes.items())
    except InputError:
        return False
    same_code = sealed.manifest.get("code") == code_digest()
    return same_data and same_code and sealed.config_toml == to_toml(config)


@contextlib.contextmanager
def claimed(out: Path, command: str) -> Iterator[None]:
    """Hold a folder while a command fills it; the same command may go on in it later.

    The system takes the lock from a process that dies, whatever killed it.

    Args:
        out: the folder.
        command: all that decides what goes into it, in words; another one may not go on.

    Raises:
        InputError: `out` holds something else, or another process fills it.
    """
    from taojax.files.records import refuse_if_taken

    mark = out / BEGUN
    if not mark.is_file():
        refuse_if_taken(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        file = mark.open("a+", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another") from error
    with file:
        _lock(file.fileno(), out)
        file.seek(0)
        before = file.read()
        if before not in ("", command):
            raise InputError(
                f"{out}: holds what another command began; repeat that one or choose a new --out"
            )
        if not before:
            file.write(command)
            file.flush()
            os.fsync(file.fileno())
        try:
            yield
            mark.unlink()
        finally:
            if os.listdir(out) == [BEGUN]:
                mark.unlink()
                out.rmdir()


def _lock(file: int, out: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        what = "another process is filling it; wait for that one or choose a new --out"
        raise InputError(f"{out}: {what}") from error
    except OSError:
        # A file system without locks: two at once cannot be told apart there.
        return
