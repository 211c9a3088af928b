"""Benchmarks' figures on disk, saved as those of a report are; the CSV behind each lies beside."""

from pathlib import Path

from matplotlib.figure import Figure

from taojax.audit.figures import picture
from taojax.files.specs import write_atomically


def save(figure: Figure, stem: Path, csv: str | None = None) -> None:
    """Write a figure as PNG and SVG.

    Args:
        figure: what was drawn.
        stem: path without a suffix.
        csv: the numbers behind it; None where the table was written already.
    """
    drawn = picture(figure, stem.name, "", "", csv or "")
    write_atomically(stem.with_suffix(".png"), drawn.png)
    write_atomically(stem.with_suffix(".svg"), drawn.svg)
    if csv is not None:
        write_atomically(stem.with_suffix(".csv"), csv)
