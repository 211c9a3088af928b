"""`python -m benchmarks gallery`: the figures of a real run on one sheet, for the README."""

from pathlib import Path

import matplotlib.image
from matplotlib.figure import Figure

from taojax.cli import main
from taojax.errors import InputError

SHEET = Path(__file__).parents[1] / ".github" / "pictures" / "gallery.png"

FRAME = 776
"""A frame of the simulated default scenario that is accepted off the map: what explain is for."""

PICTURES = {
    "retrieval": "audit/full/figures/retrieval.png",
    "diagnostics": "audit/full/figures/diagnostics.png",
    "micro-scale, 5 m": "audit/full/figures/micro.png",
    "map-out": "audit/figures/mapout.png",
    "traces": "audit/figures/traces.png",
    "ROC": "audit/default/figures/roc.png",
    "reliability": "audit/default/figures/reliability.png",
    "explain": f"audit/default/explain/frame_{FRAME}.png",
    "kidnapped": "kidnap/figures/recovery.png",
}
"""Title -> file below the output folder."""


def run(out: Path, *, sheet: Path = SHEET) -> None:
    """Audit, explain a frame, kidnap, and put the figures on one sheet.

    Args:
        out: folder of the runs.
        sheet: picture to write.

    Raises:
        InputError: a step failed.
    """
    steps = (
        ["audit", "--out", str(out / "audit"), "--no-progress"],
        ["explain", str(out / "audit" / "default"), "--frame", str(FRAME)],
        ["kidnap", "--trials", "60", "--out", str(out / "kidnap"), "--no-progress"],
    )
    for words in steps:
        if main(words):
            raise InputError(f"taojax {' '.join(words)} failed; see its message above")
    figure = Figure(figsize=(15, 11), layout="constrained")
    axes = figure.subplots(3, 3).ravel()
    for ax, (title, name) in zip(axes, PICTURES.items(), strict=True):
        ax.imshow(matplotlib.image.imread(out / name))
        ax.set_title(title, fontsize=11)
        ax.axis("off")
    sheet.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(sheet, dpi=110)
    print(f"wrote {sheet}")
