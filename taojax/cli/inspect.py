"""`taojax inspect`: what a data folder holds, and what can be expected of it, before a long run."""

import dataclasses
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import tyro

from taojax.cli.common import Compiling, Dataset, check_seed, flag, say
from taojax.cli.layout import TRUTH, advice, check_folder, missing
from taojax.errors import InputError

if TYPE_CHECKING:
    from taojax.audit.labels import Truth
    from taojax.runtime.inspection import Found

LEAST_MATCHED = 0.5
"""Share of query stamps that the truth has to know."""


@dataclasses.dataclass(frozen=True)
class Inspect(Compiling):
    """Look at a data folder before a long run: what is there, what is wrong, what to expect.

    Example: taojax inspect my_data
    """

    dataset: Dataset = tyro.MISSING
    """Data folder, laid out as data_specs/README.md says; truth/ is read where it is there."""

    anyway: bool = False
    """Do not refuse where the truth knows less than half of the query stamps."""

    seed: Annotated[int | None, flag("INT", "0")] = None
    """Seed of the command that is suggested; what is found here does not depend on chance."""

    progress: bool = True
    """Say what takes long."""


def run(args: Inspect) -> None:
    """Print what was found; refuse a folder that cannot be scored or judged."""
    check_seed(args.seed)
    check_folder(args.dataset)
    from taojax.cli import inspect_page as tell
    from taojax.cli.inspect_page import lengths, likeness
    from taojax.runtime.inspection import check, suggest_radii

    found = check(args.dataset)
    truth = _read_truth(args.dataset, found)
    page = tell.Page([str(args.dataset)])
    tell.files(page, found, has_truth=truth is not None or TRUTH in found.problems)
    matched = tell.clocks(page, found, truth)
    shape = tell.drive(page, found)
    drift_m = tell.odometry(page, found, truth, shape)
    lengths(page, found)
    command = f"taojax score {quote(str(args.dataset))}"
    if shape is not None and drift_m != tell.NO_MOTION:
        radii = suggest_radii(shape, drift_m)
        if args.progress:
            say("holding every image against the map")
        nearest_m = likeness(page, found, truth, shape, radii)
        if truth is not None:
            command = (
                f"taojax audit {quote(str(args.dataset))} {tell.radii(page, radii, nearest_m)}"
            )
    refusal = _refusal(args.dataset, found, None if args.anyway else matched)
    if refusal:
        page.end(f"refused: {refusal}")
    elif drift_m == tell.NO_MOTION:
        page.end("not ready: mend the odometry and inspect again")
    else:
        page.end("ready; next", command if args.seed is None else f"{command} --seed {args.seed}")
    print("\n".join(page.lines))
    if refusal:
        raise InputError(f"{args.dataset}: {refusal}")


def _read_truth(folder: Path, found: "Found") -> "Truth | None":
    """Read the truth where there is one; what is wrong with it is a problem like any other."""
    from taojax.audit.labels import read_truth

    path = folder / TRUTH
    if not path.exists():
        return None

    truth = found.attempt(TRUTH, lambda: read_truth(path, _n_rows(path)))
    if truth is not None:
        found.files[TRUTH] = f"{len(truth.t_s):,} rows"
        if (t := found.query_t) is not None:
            found.attempt(TRUTH, lambda: read_truth(path, len(t)))
    return truth


def _n_rows(path: Path) -> int:
    """Return how many poses a file seems to hold: its clock is of use even where that is wrong."""
    from taojax.files.specs import read_text

    return len(read_text(path).rstrip().splitlines()) - 1


def _refusal(folder: Path, found: "Found", matched: float | None) -> str:
    """Return why the folder is refused, blank where it is not."""
    if found.problems:
        names = ", ".join(found.problems)
        fix = advice(folder) if missing(folder) else "mend them and inspect again"
        return f"{len(found.problems)} problem(s): {names}; {fix}"
    if matched is not None and matched < LEAST_MATCHED:
        return (
            f"the truth knows {100 * matched:.0f} % of the query stamps; give both files one clock,"
            " or add --anyway"
        )
    return ""
