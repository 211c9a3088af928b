"""`python -m benchmarks gallery`: the pictures of README and guide, from real runs.

An audit of the simulated world, one frame explained, and a small kidnap: fewer trials than the
README's table, so that its bands are wide.
"""

from pathlib import Path

import matplotlib.image
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import concepts
from taojax.cli import main
from taojax.errors import InputError
from taojax.files.specs import read_bytes, write_atomically

PICTURES = Path(__file__).parents[1] / ".github" / "pictures"

FRAME = 776
"""A frame of the simulated default scenario that is accepted off the map: what explain is for."""

STEPS = (
    "audit --no-progress --out {out}/audit",
    f"explain {{out}}/audit/default --frame {FRAME}",
    "kidnap --trials 40 --rival-trials 12 --worlds 2 --no-stress --no-progress --out {out}/kidnap",
)
"""Commands of taojax."""

ROWS = (
    {"signals over time, levels frozen on the first half": "audit/default/figures/diagnostics.png"},
    {
        "how well each tells the two apart": "audit/default/figures/roc.png",
        "does a probability come true?": "audit/default/figures/reliability.png",
    },
    {"carried elsewhere, odometry does not notice": "kidnap/figures/recovery.png"},
)
"""Title -> file below the output folder, row by row."""

COPIES = {
    "maps.png": "audit/figures/maps.png",
    "explain.png": f"audit/default/explain/frame_{FRAME}.png",
}
"""Pictures shown as they are."""

SHADE = np.uint8(8)
"""Step between two shades of the sheet."""

WIDTH_PX = 1250
"""Of the sheet: a README shows it at about 850."""


def sheet(out: Path) -> Figure:
    """Put figures under one another, each as wide as the sheet or sharing a row.

    Args:
        out: folder of the runs.
    """
    rows = [
        [(title, matplotlib.image.imread(out / name)) for title, name in r.items()] for r in ROWS
    ]
    # Pictures of a row get the same height: their widths are as their shapes.
    shapes = [[image.shape[1] / image.shape[0] for _, image in row] for row in rows]
    heights = [1.0 / sum(shape) + 0.045 for shape in shapes]
    figure = Figure(figsize=(WIDTH_PX / 100, WIDTH_PX / 100 * sum(heights)), layout="constrained")
    for part, row, shape in zip(
        figure.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)[:, 0],
        rows, shapes, strict=True,
    ):  # fmt: skip
        axes = part.subplots(1, len(row), width_ratios=shape, squeeze=False)[0]
        for ax, (title, image) in zip(axes, row, strict=True):
            ax.imshow(image)
            ax.set_title(f"{title} (simulated)", fontsize=13)
            ax.axis("off")
    return figure


def run(out: Path, *, pictures: Path = PICTURES) -> None:
    """Audit, explain a frame, kidnap, and draw the pictures.

    Args:
        out: folder of the runs.
        pictures: folder to write to.

    Raises:
        InputError: a step failed.
    """
    for step in STEPS:
        words = [word.format(out=out) for word in step.split()]
        if main(words):
            raise InputError(f"taojax {' '.join(words)} failed; see its message above")
    draw(out, pictures)


def draw(out: Path, pictures: Path) -> None:
    """Draw the pictures from finished runs.

    Args:
        out: folder of the runs.
        pictures: folder to write to.
    """
    pictures.mkdir(parents=True, exist_ok=True)
    canvas = FigureCanvasAgg(sheet(out))
    canvas.draw()
    # Scaled pictures have a thousand shades along each line; fewer make the file half as large.
    pixels = np.asarray(canvas.buffer_rgba())[..., :3] // SHADE * SHADE
    matplotlib.image.imsave(pictures / "gallery.png", np.ascontiguousarray(pixels + SHADE - 1))
    for name, figure in (
        ("window", concepts.window()),
        ("radii", concepts.radii()),
        ("level", concepts.level(out / "audit/default")),
    ):
        figure.savefig(pictures / f"{name}.png", dpi=110)
    for name, source in COPIES.items():
        write_atomically(pictures / name, read_bytes(out / source))
    print(f"wrote gallery, concepts and copies to {pictures}")
