"""`taojax explain`: why one frame was accepted, rejected or left open."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from taojax.cli.common import Compiling, flag, say

if TYPE_CHECKING:
    import numpy as np

    from taojax.files.records import Run
    from taojax.runtime.explain import Look


@dataclasses.dataclass(frozen=True)
class Explain(Compiling):
    """Say why a frame got its verdict: its path, disagreeing frames, other places, margin, picture.

    Example: taojax explain runs/mine --frame 812
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = tyro.MISSING
    """Run folder made by `taojax score` or `taojax audit`."""

    frame: Annotated[int, tyro.conf.arg(metavar="N")] = tyro.MISSING
    """Row of signals.csv, from 0."""

    out: Annotated[Path | None, flag("DIR", "RUN/explain")] = None
    """Where to write frame_N.png, .svg and .csv."""

    progress: bool = True
    """Changes nothing: the answer is there at once."""


def run(args: Explain) -> None:
    """Follow the answer once more, tell and draw."""
    from taojax.cli.explain_page import headline, page
    from taojax.files.pose_graph_io import read_verdicts
    from taojax.files.records import read_run
    from taojax.runtime.explain import explain

    sealed = read_run(args.run)
    verdicts = read_verdicts(args.run, sealed)
    look = explain(args.run, sealed, args.frame)
    if look.gap > 1.0:
        _refuse(args.run, sealed, look)
    print("\n".join(page(look, sealed, verdicts)))
    stem = (args.out or args.run / "explain") / f"frame_{args.frame}"
    _draw(stem, sealed, look, headline(look, verdicts))
    say(f"picture: {stem}.png, .svg and .csv")


def _refuse(folder: Path, sealed: "Run", look: "Look") -> None:
    """Stop where the path does not cost what was sealed."""
    from taojax.runtime.score import facts_of

    here = facts_of("", folder, 0)
    names = [name for name in ("device", "versions", "code") if sealed.manifest[name] != here[name]]
    differs = f"here differ {', '.join(names)}" if names else "device, versions and code are equal"
    say(
        f"taojax: {folder}: the path of frame {look.frame} costs {look.cost:.6g} where "
        f"{look.sealed:.6g} is sealed, so nothing can be explained ({differs}); score again"
    )
    raise SystemExit(1)


def _draw(stem: Path, sealed: "Run", look: "Look", headline: str) -> None:
    """Write the picture three ways."""
    import numpy as np
    from matplotlib.figure import Figure

    from taojax.audit.figures import picture
    from taojax.files.specs import write_atomically
    from taojax.files.tables import table_text
    from taojax.plots import WindowMarks, draw_window

    map_m = np.stack([sealed.map_poses[c] for c in ("x_m", "y_m")], axis=1)
    window, found = look.window, look.hypotheses
    has = (window.anchor >= 0)[:, None]
    anchor_m = np.where(has, map_m[np.maximum(window.anchor, 0)], np.nan)
    marks = WindowMarks(
        map_m, window.path_m, anchor_m, window.is_inlier, map_m[look.candidate],
        found.pose, found.cost,
    )  # fmt: skip
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_window(marks, is_close=True, ax=left).set_title("the window", fontsize=10)
    draw_window(marks, is_close=False, ax=right).set_title("the map", fontsize=10)
    figure.suptitle(headline, fontsize=11)
    labels = {
        label: handle
        for ax in (left, right)
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        labels.values(), labels.keys(), loc="outside lower center", ncols=3, frameon=False,
        fontsize=8,
    )  # fmt: skip
    drawn = picture(figure, stem.name, "", "", table_text("explain", _rows(look, map_m, anchor_m)))
    for suffix, content in ((".png", drawn.png), (".svg", drawn.svg), (".csv", drawn.csv)):
        write_atomically(stem.with_suffix(suffix), content)


def _rows(look: "Look", map_m: "np.ndarray", anchor_m: "np.ndarray") -> "dict[str, np.ndarray]":
    """Return the columns of data_specs/explain.toml: frames, then candidates, then places."""
    import numpy as np

    window, found = look.window, look.hypotheses
    n, c, k = len(window.frame), len(look.candidate), len(found.cost)
    # One column from its part of each kind; None is blank.
    joined = lambda *parts: np.concatenate(
        [np.full(size, np.nan) if part is None else np.asarray(part, float)
         for part, size in zip(parts, (n, c, k), strict=True)]
    )  # fmt: skip
    candidate_m, pose = map_m[look.candidate], found.pose
    return {
        "kind": np.array(["frame"] * n + ["candidate"] * c + ["place"] * k, dtype=object),
        "number": joined(window.frame, np.arange(1, c + 1), np.arange(1, k + 1)),
        "x_m": joined(window.path_m[:, 0], candidate_m[:, 0], pose[:, 0]),
        "y_m": joined(window.path_m[:, 1], candidate_m[:, 1], pose[:, 1]),
        "theta_rad": joined(None, None, pose[:, 2]),
        "map_index": joined(window.anchor, look.candidate, None),
        "map_x_m": joined(anchor_m[:, 0], candidate_m[:, 0], None),
        "map_y_m": joined(anchor_m[:, 1], candidate_m[:, 1], None),
        "cost": joined(window.cost, None, found.cost),
        "weight": joined(window.weight, None, None),
        "similarity": joined(None, look.similarity, None),
        "agrees": joined(window.is_inlier, None, None),
    }
