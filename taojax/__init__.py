"""taojax: am I lost, or just somewhere new, and may this loop closure enter my graph?

The names a robot program needs, and `read_run`, which hands the tables of a run folder to people.
They are loaded on first use, so that importing the package costs nothing; none of them knows the
judge.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from taojax.config import Config, StreamConfig
    from taojax.errors import ConfigError, InputError, TaojaxError
    from taojax.files.results import Results, read_run
    from taojax.runtime.frames import STATUSES, Frame, StreamRecord
    from taojax.runtime.maps import MapTables, map_tables
    from taojax.runtime.stream import StreamState, init, replay, step

_HOMES = {
    "taojax.config": ("Config", "StreamConfig"),
    "taojax.errors": ("ConfigError", "InputError", "TaojaxError"),
    "taojax.files.results": ("Results", "read_run"),
    "taojax.runtime.maps": ("MapTables", "map_tables"),
    "taojax.runtime.frames": ("STATUSES", "Frame", "StreamRecord"),
    "taojax.runtime.stream": ("StreamState", "init", "replay", "step"),
}  # fmt: skip

__all__ = [
    "STATUSES",
    "Config",
    "ConfigError",
    "Frame",
    "InputError",
    "MapTables",
    "Results",
    "StreamConfig",
    "StreamRecord",
    "StreamState",
    "TaojaxError",
    "__version__",
    "init",
    "map_tables",
    "read_run",
    "replay",
    "step",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(home), name)
    raise AttributeError(f"module 'taojax' has no attribute {name!r}")
