"""One self-contained HTML page out of sentences, tables and figures, its terms explained."""

import base64
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from taojax.audit.calibration import LOGISTIC
from taojax.audit.figures import Picture
from taojax.audit.opening import UNKNOWN, Drawing, Number
from taojax.decisions import plain
from taojax.files.specs import load_spec

_ACCEPTED = "share of the map-out test frames with the verdict accept; abstaining accepts nothing"

_REJECTED = "share of the in-map test frames with the verdict reject; abstaining rejects nothing"


class Piece(NamedTuple):
    """A part of a sentence; a defined word carries what hovering tells."""

    text: str
    title: str = ""


@cache
def about(column: str, spec: str = "metrics") -> str:
    """Return the definition of a column as its spec gives it."""
    return next(c["about"] for c in load_spec(spec)["columns"] if c["name"] == column)


@cache
def glossary() -> Mapping[str, str]:
    """Return word -> definition; numbers are defined where their spec defines them."""
    return {
        "accepted": "final verdict accept: the probability of being wrong is at or below the "
        "frozen level",
        "rejected": "final verdict reject: the answer is more likely wrong than right",
        "abstained": "final verdict abstain: neither sure enough to accept nor to reject, or "
        "there is no answer (warming up, no candidate), or no level",
        "wrong share": "of the accepted test answers, the share farther than max(r_out, 2 r_in) "
        "from the truth",
        "recall": "of the right test answers of frames within r_out of a map pose, the share "
        "accepted",
        "right": "an answer within max(r_out, 2 r_in) of the truth",
        "in-map": "a frame whose true position lies within r_in of a map pose",
        "map-out": "a frame whose true position lies farther than r_out from every map pose",
        "off the map": "map-out: the true position lies farther than r_out from every map pose",
        "grey": "frames between r_in and r_out: neither in-map nor map-out, so not scored",
        "wrong place": "the answered pose lies more than max(r_out, 2 r_in) from the truth",
        "calibration split": "the first part of the recording; thresholds and the probability "
        "are fitted on it and then frozen",
        "test frames": "the last part of the recording, one window after the calibration split; "
        "only scored, never fitted on",
        "False acceptance rate": _ACCEPTED,
        "FAR of the verdicts": _ACCEPTED,
        "FAR at the threshold": about("far"),
        "FAR": "false acceptance rate: share of the map-out test frames that were accepted",
        "False rejection rate": _REJECTED,
        "FRR of the verdicts": _REJECTED,
        "FRR at the threshold": about("frr"),
        "FRR": "false rejection rate: share of the in-map test frames that were rejected",
        "first rejection": about("delay_frames"),
        "AUROC": about("auroc"),
        "AUPR": about("aupr_out"),
        "FAR at 95 %": about("far_at_95"),
        "prevalence": about("prevalence_test"),
        "threshold": about("threshold"),
        "probability": "calibrated probability of being map-out, with hindsight as the final "
        "verdict; `fused` in tables and figures",
        "interval unknown": "every resample of the frames gives this same number, as it does when "
        "all frames or none are counted; that is no proof that it is exact",
        "95 % interval": "from a circular block bootstrap over time: whole blocks of frames are "
        "drawn again, because neighbours repeat each other",
        "tao": about("tao", "signals"),
        "best similarity": about("top1", "signals"),
        "velocity gate": about("velocity", "signals"),
        "C_geom": about("c_geom", "signals"),
        "Conformal threshold": "accept at or below it; chosen so that the false acceptance rate "
        "stays under alpha in the stated share of recordings",
        "median": "half of the values lie below",
    }


WRONG = (
    "calibrated probability that the {} answer is wrong, farther than max(r_out, 2 r_in) from the "
    "truth"
)

PLAIN = (
    "the paper's calibrated logistic model: probability of being off the map from {}; fitted on "
    "the calibration half"
)

FUSED = "calibrated probability of being off the map, with hindsight as the final verdict"


@cache
def names_of_signals() -> Mapping[str, str]:
    """Return every signal, and `fused`, with its meaning and unit."""
    found = {}
    for column in load_spec("signals")["columns"]:
        if column.get("signal"):
            unit = column.get("unit", "1")
            found[column["name"]] = column["about"] + (f" [{unit}]" if unit != "1" else "")
    own = {
        "probability_wrong_now": WRONG.format("causal"),
        "probability_wrong": WRONG.format("final"),
    }
    logistic = {name: PLAIN.format(", ".join(columns)) for name, columns in LOGISTIC.items()}
    return found | own | logistic | {"fused": FUSED}


def names_of_tables(specs: Sequence[str]) -> dict[str, str]:
    """Return the columns of some tables with their meanings; one interval stands for all.

    Args:
        specs: names of table specs; where two define one column, both are told.
    """
    found: dict[str, list[str]] = {}
    for spec in specs:
        columns = {column["name"]: column for column in load_spec(spec)["columns"]}
        bounds = {f"{name}_{end}" for name in columns for end in ("lo", "hi")}
        for name, column in columns.items():
            if name not in bounds and column.get("about"):
                told = found.setdefault(name, [])
                told += [column["about"]] if column["about"] not in told else []
    return {name: "; or: ".join(told) for name, told in found.items()}


def marked(sentence: str, words: Mapping[str, str]) -> list[Piece]:
    """Cut a sentence at its defined words; each is marked where it comes first.

    Args:
        sentence: plain text.
        words: word -> definition; the longest match wins.
    """
    if not words:
        return [Piece(sentence)]
    longest = sorted(words, key=len, reverse=True)
    pattern = re.compile(r"(?<![\w-])(" + "|".join(map(re.escape, longest)) + r")(?![\w-])")
    pieces, end, told = [], 0, set()
    for match in pattern.finditer(sentence):
        if match[0] in told:
            continue
        told.add(match[0])
        pieces += [Piece(sentence[end : match.start()]), Piece(match[0], words[match[0]])]
        end = match.end()
    return [piece for piece in (*pieces, Piece(sentence[end:])) if piece.text]


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
    """JSON from `frame_explorer.route_json`; empty = no section along the route."""


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
