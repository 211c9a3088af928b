"""A run folder as pandas tables, for people who go on with its numbers.

The robot's side cannot reach this module; there a run is `records.Run`, plain arrays.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from taojax.files import records
from taojax.files.pose_graph_io import refuse_foreign
from taojax.files.specs import load_spec
from taojax.files.tables import read_frames, read_table

JUDGED = ("labels.csv", "verdicts.csv", "metrics.csv")
"""What the judge writes; one without the others is a broken folder."""

SUMMARIES = ("recall", "micro", "errors", "conformal", "counts", "rates")
"""What else it may write, under `tables/`."""


class Results(NamedTuple):
    """The tables of one run; columns and units are those of the specs in data_specs/."""

    signals: pd.DataFrame
    """(T rows) by frame."""

    map_poses: pd.DataFrame
    """(M rows) by map row."""

    decisions: pd.DataFrame | None
    """(T rows) by frame: run-time verdicts; None where nobody decided."""

    labels: pd.DataFrame | None
    """(T rows) by frame; None where the run was not judged."""

    verdicts: pd.DataFrame | None
    """(T rows) by frame; None where the run was not judged."""

    metrics: pd.DataFrame | None
    """By signal, the last row is `fused`; None where the run was not judged."""

    tables: dict[str, pd.DataFrame]
    """The judge's smaller tables: those of `SUMMARIES` that are there."""


def _table(name: str, columns: Mapping[str, np.ndarray], by: str | None = None) -> pd.DataFrame:
    """Return columns of a spec as a table, whole numbers as such where no cell may be blank."""
    whole = {
        column["name"]
        for column in load_spec(name)["columns"]
        if column.get("type") == "int" and not column.get("blank")
    }
    table = pd.DataFrame(
        {key: v.astype(np.int64) if key in whole else v for key, v in columns.items()}
    )
    return table if by is None else table.set_index(by)


def read_run(run: str | Path, *, judged: str | Path | None = None) -> Results:
    """Read a sealed run, and what the judge found, as pandas tables.

    Args:
        run: folder made by `taojax score` or `taojax audit`; one scenario of it.
        judged: where `taojax evaluate --out` wrote; the run folder if omitted.

    Returns:
        Tables by frame or by signal; those of the judge are None where it was not there.

    Raises:
        InputError: seal broken, a file is missing or malformed, or the judge's files speak of
            another run.
    """
    run = Path(run)
    sealed, folder = records.read_run(run), Path(judged or run)
    found: dict[str, pd.DataFrame] = {}
    if judged is not None or any((folder / name).is_file() for name in JUDGED):
        refuse_foreign(folder, sealed)
        n_frames = len(sealed.signals["frame"])
        for name in ("labels", "verdicts"):
            columns = read_frames(folder / f"{name}.csv", name, n_frames)
            found[name] = _table(name, columns, "frame")
        metrics = read_table(folder / "metrics.csv", "metrics")
        found["metrics"] = _table("metrics", metrics, "signal")
    extra = {name: folder / f"tables/{name}.csv" for name in SUMMARIES if found}
    return Results(
        signals=_table("signals", sealed.signals, "frame"),
        map_poses=_table("map_poses", sealed.map_poses),
        decisions=None
        if sealed.decisions is None
        else _table("verdicts", sealed.decisions, "frame"),
        labels=found.get("labels"),
        verdicts=found.get("verdicts"),
        metrics=found.get("metrics"),
        tables={n: _table(n, read_table(path, n)) for n, path in extra.items() if path.is_file()},
    )
