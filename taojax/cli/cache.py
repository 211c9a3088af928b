"""What JAX has compiled is kept on disk for the next command."""

import hashlib
import os
import platform
import tempfile
import warnings
from pathlib import Path

LEAST_S = "0"
"""A recording needs some 80 programs, 1.5 MB; without the small ones it starts a second later."""


def keep_compiled(*, is_wanted: bool) -> str | None:
    """Let JAX keep what it compiles; to be called before JAX is imported.

    It goes by the environment, which commands in fresh interpreters inherit. A folder that the user
    has named there stays.

    Args:
        is_wanted: False turns it off, whatever the environment says.

    Returns:
        Why nothing is kept although it is wanted, in one line.
    """
    if not is_wanted:
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
        return None
    # An entry that another process has half written, or for which there is no room, costs time.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    # XLA may alarm at every entry that it reads, though it wrote it itself.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", LEAST_S)
    if {"JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"} & set(os.environ):
        return None
    try:
        folder = _home() / "taojax" / _processor()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError) as error:
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
        return f"note: every command compiles again: no cache folder can be written ({error})"
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    return None


def _home() -> Path:
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return named if named.is_absolute() else Path.home() / ".cache"


def _processor() -> str:
    """Return a short name of this kind of processor: no other can run what was compiled here."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    kinds = {line for line in lines if line.startswith(("model name", "flags", "Features", "CPU "))}
    return hashlib.sha256("\n".join([platform.machine(), *sorted(kinds)]).encode()).hexdigest()[:8]
