"""`taojax rerun`: score a sealed run again and hold the new bytes against the seal."""

import dataclasses
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro

from taojax.cli.common import Compiling, draws_bars, flag, say
from taojax.cli.from_images import FOLDER
from taojax.errors import GateError, InputError

if TYPE_CHECKING:
    import numpy as np

    from taojax.files.records import Run

OF_LARGEST = 1e-5
"""Tolerance of a number, as a share of the largest of its column: other devices and compilers round
float32 sums in another order. Whole numbers and stamps have none."""

OF_ITSELF = 1e-4
"""The same for a signal, as a share of itself, on top: some span ten orders of magnitude."""

LATER = ("about.toml", "query/retrievals.npz")
"""Inputs that change what is read when they are added to a data folder."""

PLACE = ("dataset", "command")
"""Entries of a manifest that only say where the data lie."""


@dataclasses.dataclass(frozen=True)
class Rerun(Compiling):
    """Score a sealed run again, from its manifest and config.toml, and compare with the seal.

    Exit code 0 where signals and answers are the same or within tolerance, else 5.

    Example: taojax rerun runs/mine --data my_data
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder made by `taojax score` or `taojax audit`."""

    data: Annotated[Path | None, flag("DATASET", "where the manifest says")] = None
    """Data folder of the run; the hashes of its files must be those in the manifest."""

    out: Annotated[Path | None, flag("DIR", "kept nowhere")] = None
    """Folder to make for the new run."""

    progress: bool = True
    """Draw progress bars."""


class Verdict(NamedTuple):
    """How a sealed file compares with the one made again."""

    is_close: bool
    text: str


def run(args: Rerun) -> None:
    """Score again, print how each sealed file compares, and fail where one differs."""
    from taojax.config import from_toml
    from taojax.files.records import refuse_if_taken
    from taojax.runtime.score import score

    sealed = _read(args.run)
    if args.out is not None:
        refuse_if_taken(args.out)
    data = args.data or _find(args.run, str(sealed.manifest.get("dataset", "")))
    _check_inputs(data, sealed.manifest)
    say(f"scoring {data} again")
    with tempfile.TemporaryDirectory() as scratch:
        out = args.out or Path(scratch) / "run"
        manifest = score(
            data,
            out,
            from_toml(args.run / "config.toml"),
            calibration=_calibration(args.run, sealed),
            rival_logs=_rival_logs(sealed),
            progress=draws_bars(args.progress),
        )
        verdicts = _compare(args.run, out, sealed.manifest["sha256"], manifest["sha256"])
    width = max(len(name) for name in verdicts)
    lines = [f"{name:{width}s}  {verdict.text}" for name, verdict in verdicts.items()]
    print("\n".join([*lines, *_changes(sealed.manifest, manifest)]))
    if differing := [name for name, verdict in verdicts.items() if not verdict.is_close]:
        raise GateError(f"{args.run}: not made again: {', '.join(differing)} differ; see above")


def _read(run: Path) -> "Run":
    """Return a sealed run of `score`; other folders are told by name."""
    from taojax.files.records import SEALED, read_manifest, read_run
    from taojax.files.specs import fail

    if not set(SEALED) <= set(read_manifest(run)["sha256"]):
        raise fail(run, "was not made by score", "rerun knows runs of `taojax score` and `audit`")
    return read_run(run)


def data_places(run: Path, named: str) -> Iterator[Path]:
    """Yield where the data may lie: as named, beside the run, and where `audit` puts its own."""
    yield Path(named)
    yield run.resolve().parent / named
    yield run / "data"
    yield run.resolve().parent / "data" / run.resolve().name
    yield run.resolve().parent / FOLDER / Path(named).name


def _find(run: Path, named: str) -> Path:
    for place in data_places(run, named):
        if named and (place / "map/poses.csv").is_file():
            return place
    what = f"its data are not at {named!r} any more" if named else "does not say where its data lie"
    raise InputError(f"{run}: {what}; name them with --data")


def _check_inputs(data: Path, manifest: Mapping[str, Any]) -> None:
    """Refuse data other than those that were sealed."""
    from taojax.files.records import digest_file, input_hashes

    if not data.is_dir():
        raise InputError(f"{data}: no such data folder; name that of the run with --data")
    inputs = input_hashes(manifest)
    for name, want in inputs.items():
        got = digest_file(data / name)
        if got != want:
            what = f"sha256 {got[:12]}... is not {want[:12]}... of the manifest"
            raise InputError(f"{data / name}: {what}; name the data of this run with --data")
    for name in LATER:
        if name not in inputs and (data / name).exists():
            raise InputError(f"{data / name}: was not there when the run was sealed; move it away")


def _calibration(run: Path, sealed: "Run") -> Any:
    """Return the calibration that decided, where there was one."""
    from taojax.risk import read_calibration

    return (
        read_calibration(run / "detector.toml")
        if "detector.toml" in sealed.manifest["sha256"]
        else None
    )


def _rival_logs(sealed: "Run") -> int | None:
    """Return on how many trials the rivals ran; None where they were not asked for."""
    import numpy as np

    if sealed.tracks is None:
        return None
    ran = [np.isfinite(t.signal) for name, t in sealed.tracks.items() if name != "tao_rank"]
    if not ran:
        return 0
    length = sealed.manifest.get("trial_frames")
    if length is None:
        return sys.maxsize
    return -(-int(ran[0].sum()) // int(length))


def _compare(
    old: Path, new: Path, hashes: Mapping[str, str], again: Mapping[str, str]
) -> dict[str, Verdict]:
    """Compare every sealed file with the one made again."""
    from taojax.files.records import INPUTS

    names = sorted(name for name in {*hashes, *again} if not name.startswith(INPUTS))
    verdicts = {}
    for name in names:
        if name not in hashes:
            verdicts[name] = Verdict(True, "sealed now, but not then")
        elif name not in again:
            verdicts[name] = Verdict(True, "sealed then, but not made any more")
        elif hashes[name] == again[name]:
            verdicts[name] = Verdict(True, "same bytes")
        elif name.endswith((".csv", ".npz")):
            verdicts[name] = _by_value(old / name, new / name)
        else:
            verdicts[name] = Verdict(True, "other text: settings or their names were added since")
    return verdicts


def _columns(path: Path) -> dict[str, Any]:
    from taojax.files.specs import read_npz
    from taojax.files.tables import read_table

    return read_npz(path, path.stem) if path.suffix == ".npz" else read_table(path, path.stem)


def _allowed(file: str, name: str, values: "np.ndarray") -> "np.ndarray":
    """Return how far each number may move."""
    import numpy as np

    from taojax.files.specs import load_spec

    columns = load_spec(file).get("columns", ())
    column = next((column for column in columns if column["name"] == name), {})
    if values.dtype.kind in "iu" or column.get("type") == "int" or name == "t_s":
        return np.zeros(values.shape)
    size = np.abs(values)
    share = OF_ITSELF if column.get("signal") else 0.0
    return OF_LARGEST * np.nanmax(size, initial=0.0) + share * size


def _by_value(old: Path, new: Path) -> Verdict:
    """Compare two tables or archives column by column."""
    import numpy as np

    before, after = _columns(old), _columns(new)
    off, largest = [], (0.0, "")
    for name in before:
        a, b = before[name], after.get(name)
        if b is None or np.shape(b) != np.shape(a):
            return Verdict(False, f"differs in shape: {name}")
        if a.dtype == object:
            is_off = a != b
            size = np.where(is_off, np.inf, 0.0)
        else:
            allowed = _allowed(old.stem, name, a)
            a, b = a.astype(float), b.astype(float)
            is_same = (a == b) | (np.isnan(a) & np.isnan(b))
            size = np.where(is_same, 0.0, np.abs(a - b))
            # Where one of the two is blank the size is NaN, which is within nothing.
            is_off = ~is_same & ~(size <= allowed)
        if is_off.any():
            at = np.argwhere(is_off)
            frame = int(at[0, 1 if old.name == "tracks.npz" else 0])
            first = tuple(at[0])
            n = len(np.unique(at[:, 1 if old.name == "tracks.npz" else 0]))
            values = f"{after[name][first]} instead of {before[name][first]}"
            off.append(f"{name} in {n} rows, first row {frame} (from 0): {values}")
        elif size.max(initial=0.0) > largest[0]:
            largest = float(size.max()), name
    if off:
        more = f"; and {len(off) - 3} more columns" if len(off) > 3 else ""
        return Verdict(False, f"differs: {'; '.join(off[:3])}{more}")
    if not largest[1]:
        return Verdict(True, "same values, other bytes")
    return Verdict(
        True,
        f"within tolerance ({OF_LARGEST:g} of the column's largest, {OF_ITSELF:g} of a signal on "
        f"top): at most {largest[0]:.3g}, in {largest[1]}",
    )


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Say whether the seals are equal, and what in the manifests is not."""
    from taojax.files.records import seal_of

    if new["seal"] == old["seal"]:
        return [f"seal  the same: {old['seal'][:12]}..."]
    if seal_of({**new, **{key: old[key] for key in PLACE if key in old}}) == old["seal"]:
        return [f"seal  the same but for where the data lie: {old['seal'][:12]}..."]
    said = []
    for key in sorted({*old, *new} - {"sha256", "seal", *PLACE}):
        if old.get(key) != new.get(key):
            said.append(f"  {key}: {_change(old.get(key), new.get(key))}")
    return [
        f"seal  another: {new['seal'][:12]}... instead of {old['seal'][:12]}..., "
        f"because of {'these entries' if said else 'the files above'}",
        *said,
    ]


def _change(old: Any, new: Any) -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted(key for key in {*old, *new} if old.get(key) != new.get(key))
        return "; ".join(f"{key} {old.get(key)} then, {new.get(key)} now" for key in keys)
    short = (text if len(text) <= 40 else f"{text[:12]}..." for text in (str(old), str(new)))
    return "{} then, {} now".format(*short)
