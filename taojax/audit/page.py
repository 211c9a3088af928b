"""One self-contained HTML page out of sentences, tables and figures."""

import base64
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from taojax.audit.figures import Picture
from taojax.audit.glossary import marked, names_of_signals
from taojax.audit.opening import UNKNOWN, Number
from taojax.audit.opening_map import Drawing
from taojax.specs import load_spec
from taojax.verdicts import plain

_HALF = 5  # columns up to which two tables fit side by side


class Cell(NamedTuple):
    """A table cell with its interval or unit in small print, and what hovering tells."""

    text: str
    small: str = ""
    title: str = ""
    is_text: bool = False


class Grid(NamedTuple):
    """A table ready for the page."""

    title: str
    note: str
    source: str
    """File of the run folder that holds it."""

    head: list[Cell]
    rows: list[list[Cell]]
    is_half: bool = False
    """Whether two fit side by side."""

    main: tuple[str, ...] = ()
    """First cells of the rows that are shown until the reader asks for all; empty = all."""


class Opening(NamedTuple):
    """What a page shows first of a run: one picture and three numbers."""

    drawing: Drawing
    numbers: Sequence[Number]
    name: str = ""
    """Of the scenario, where the page tells of several."""

    href: str = ""
    """Its page."""


class Page(NamedTuple):
    """Everything on one page."""

    title: str
    subtitle: str
    notes: Sequence[str]
    headline: Sequence[str]
    """What was found, in sentences."""

    grids: Sequence[Grid]
    pictures: Sequence[Picture]
    facts: Mapping[str, str]
    command: str
    lead: Sequence[str] = ()
    """Sentences above everything else."""

    cards: Sequence[Cell] = ()
    """Numbers below them, where the page opens with no picture."""

    openings: Sequence[Opening] = ()
    """Picture and numbers below them; all that follows is folded where there is one."""

    words: Mapping[str, str] = {}
    """Word -> definition; what hovering over it in a sentence tells."""

    terms: Mapping[str, Mapping[str, str]] = {}
    """Heading -> name -> definition: names of signals and columns, which no sentence marks."""

    warnings: Sequence[str] = ()
    """Sentences that should alarm; those not in `lead` stand below the openings."""

    route: str = ""
    """JSON from `route.route_json`; empty = no section along the route."""


def number(value: float, column: Mapping[str, Any]) -> str:
    """Return a number as a reader wants it: rates with three decimals, others four digits."""
    if np.isnan(value):
        return "—"
    if column.get("type") == "int":
        return f"{value:.0f}"
    return f"{value:.3f}" if column.get("max") == 1 else plain(value)


def grid(
    name: str,
    table: Mapping[str, np.ndarray],
    *,
    title: str,
    note: str = "",
    columns: Sequence[str] | None = None,
) -> Grid:
    """Lay out a table of a spec; columns x_lo and x_hi become the small print of column x.

    Args:
        name: the spec; its `about` entries are what hovering over a column tells.
        table: column -> values.
        title: heading.
        note: a sentence above the table.
        columns: which to show, all without an interval of their own if omitted.
    """
    specs = {column["name"]: column for column in load_spec(name)["columns"]}
    bounds = {f"{c}_{end}" for c in specs for end in ("lo", "hi")}
    shown = columns or [c for c in specs if c not in bounds]
    titles, n = names_of_signals(), len(next(iter(table.values())))
    rows: list[list[Cell]] = [[] for _ in range(n)]
    for column in shown:
        kind = specs[column].get("type")
        for at, row in enumerate(rows):
            value = table[column][at]
            if kind == "text":
                row.append(Cell(str(value), title=titles.get(str(value), ""), is_text=True))
                continue
            small = ""
            if f"{column}_lo" in specs and np.isfinite(table[f"{column}_lo"][at]):
                low, high = table[f"{column}_lo"][at], table[f"{column}_hi"][at]
                ends = [number(float(v), specs[column]) for v in (low, high)]
                small = " to ".join(ends) if low < high else UNKNOWN
            row.append(Cell(number(float(value), specs[column]), small))
    head = [
        Cell(c, specs[c].get("unit", ""), specs[c].get("about", ""), specs[c].get("type") == "text")
        for c in shown
    ]
    source = "metrics.csv" if name == "metrics" else f"tables/{name}.csv"
    return Grid(title, note, source, head, rows, is_half=len(shown) <= _HALF)


def _data_uri(svg: bytes) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode()


def _beside(name: str) -> str:
    return resources.files("taojax.audit").joinpath(name).read_text(encoding="utf-8")


def render(page: Page) -> str:
    """Return the page as HTML that needs no network and no other file."""
    from jinja2 import DictLoader, Environment, StrictUndefined

    names = ("report.html.j2", "route.html.j2")
    environment = Environment(
        loader=DictLoader({name: _beside(name) for name in names}),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    uris: dict[str, Any] = {drawn.name: _data_uri(drawn.svg) for drawn in page.pictures}
    return environment.get_template("report.html.j2").render(
        page=page,
        uris=uris,
        mark=lambda sentence: marked(sentence, page.words),
        style=_beside("report.css"),
        scripts={
            "route": "".join(_beside(f"route_{part}.js") for part in ("data", "map", "panel")),
            "page": _beside("page.js"),
        },
    )
