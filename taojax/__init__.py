"""taojax: am I lost, or just somewhere new, and may this loop closure enter my graph?

The names a robot program needs, and `read_run`, which hands the tables of a run folder to people.
They are loaded on first use, so that importing the package costs nothing; none of them knows the
judge.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from taojax.config import AuditConfig, Config, StreamConfig, VerdictConfig
    from taojax.core.cost import Branch, BranchCost, CostParams, branch_cost
    from taojax.core.refine import Refinement, refine
    from taojax.errors import ConfigError, InputError, TaojaxError
    from taojax.files.results import Results, read_run
    from taojax.risk import Calibration, read_calibration
    from taojax.runtime.frames import STATUSES, Frame, StreamRecord
    from taojax.runtime.hindsight import smooth
    from taojax.runtime.maps import MapTables, map_tables
    from taojax.runtime.retrieval import retrieve
    from taojax.runtime.score import verdicts
    from taojax.runtime.stream import StreamState, init, replay, step
    from taojax.runtime.watch import Watch

_HOMES = {
    "taojax.config": ("AuditConfig", "Config", "StreamConfig", "VerdictConfig"),
    "taojax.core.cost": ("Branch", "BranchCost", "CostParams", "branch_cost"),
    "taojax.core.refine": ("Refinement", "refine"),
    "taojax.errors": ("ConfigError", "InputError", "TaojaxError"),
    "taojax.files.results": ("Results", "read_run"),
    "taojax.risk": ("Calibration", "read_calibration"),
    "taojax.runtime.frames": ("STATUSES", "Frame", "StreamRecord"),
    "taojax.runtime.hindsight": ("smooth",),
    "taojax.runtime.maps": ("MapTables", "map_tables"),
    "taojax.runtime.retrieval": ("retrieve",),
    "taojax.runtime.score": ("verdicts",),
    "taojax.runtime.stream": ("StreamState", "init", "replay", "step"),
    "taojax.runtime.watch": ("Watch",),
}  # fmt: skip

__all__ = [
    "STATUSES",
    "AuditConfig",
    "Branch",
    "BranchCost",
    "Calibration",
    "Config",
    "ConfigError",
    "CostParams",
    "Frame",
    "InputError",
    "MapTables",
    "Refinement",
    "Results",
    "StreamConfig",
    "StreamRecord",
    "StreamState",
    "TaojaxError",
    "VerdictConfig",
    "Watch",
    "__version__",
    "branch_cost",
    "init",
    "map_tables",
    "read_calibration",
    "read_run",
    "refine",
    "replay",
    "retrieve",
    "smooth",
    "step",
    "verdicts",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(home), name)
    raise AttributeError(f"module 'taojax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
