"""Ways in which a sound file becomes a hostile one, by what kind of file it is."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

NASTY = (
    "", " ", "nan", "NaN", "-nan", "inf", "-inf", "1e400", "-1e400", "1e308", "1e-320", "-0", "1_0",
    "0x10", "1e", "1,5", "٣", "½", "9" * 30, "-" + "9" * 30, "9" * 5000, "9223372036854775807",
    "9223372036854775808", "-9223372036854775809", "18446744073709551616", "1e18", "2e8", "-1", "0",
    "1.0000001", "True", "None", "'", '"', '"1"', "#", "# 1", "=1+1", "\0", "\x1c",
    "\u2028", "\ufeff", "é", "../../escape", "/etc/passwd", "..", "C:\\x", "a/../../b", "%s%n",
    "{0}", "$(touch x)", "x" * 3000,
)  # fmt: skip
"""Cells that break careless parsers."""

Rng = np.random.Generator


def pick(rng: Rng, among: Sequence[Any]) -> Any:
    return among[int(rng.integers(len(among)))]


def _flip(raw: bytes, rng: Rng) -> bytes:
    data = bytearray(raw)
    for _ in range(pick(rng, (1, 1, 2, 5, 40))):
        if data:
            # Headers matter more than what they describe.
            most = len(data) if rng.random() < 0.5 else min(len(data), 256)
            data[int(rng.integers(most))] = int(rng.integers(256))
    return bytes(data)


def _cut(raw: bytes, rng: Rng) -> bytes:
    return raw[: int(rng.integers(len(raw) + 1))]


def _insert(raw: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(len(raw) + 1))
    return raw[:at] + rng.bytes(pick(rng, (1, 4, 64))) + raw[at:]


def _nothing(raw: bytes, rng: Rng) -> bytes:
    return b""


def _twice(raw: bytes, rng: Rng) -> bytes:
    return raw + raw


BYTES = (_flip, _flip, _flip, _cut, _cut, _insert, _nothing, _twice)


def _cell(text: str, rng: Rng, separator: str | None) -> str:
    lines = text.split("\n")
    row = int(rng.integers(len(lines)))
    cells = lines[row].split(separator)
    if not cells:
        return text
    for _ in range(int(rng.integers(1, 3))):
        at, old = int(rng.integers(len(cells))), str(pick(rng, cells))
        cells[at] = str(pick(rng, (*NASTY, old, old + "0", "-" + old, old[::-1], old + "e9")))
    lines[row] = (separator or " ").join(cells)
    return "\n".join(lines)


def _column(text: str, rng: Rng, separator: str | None) -> str:
    """Give a whole column one value, factor or shift."""
    rows = [line.split(separator) for line in text.split("\n")]
    at, kind = int(rng.integers(max(1, *map(len, rows)))), int(rng.integers(5))
    value, factor = pick(rng, NASTY), float(10.0 ** rng.integers(-12, 13))
    for cells in rows:
        if at < len(cells):
            if kind == 0:
                cells[at] = value
            elif kind == 1:
                del cells[at]
            elif kind == 2:
                cells.insert(at, "0")
            else:
                try:
                    moved = float(cells[at]) * factor if kind == 3 else float(cells[at]) + factor
                    cells[at] = repr(moved)
                except ValueError:
                    pass
    return "\n".join((separator or " ").join(cells) for cells in rows)


def _lines(text: str, rng: Rng, separator: str | None) -> str:
    lines = text.split("\n")
    a, b = (int(rng.integers(len(lines))) for _ in range(2))
    kind = int(rng.integers(7))
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines.insert(a, lines[b])
    elif kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 3:
        lines = lines[: max(0, a - 1)]
    elif kind == 4:
        lines.insert(a, pick(rng, NASTY))
    elif kind == 5:
        lines[a] = lines[a][: int(rng.integers(len(lines[a]) + 1))]
    else:
        lines = lines[:1]
    return "\n".join(lines)


def _words(text: str, rng: Rng, separator: str | None) -> str:
    """Replace one word of a TOML or JSON file."""
    words = text.split(" ")
    many = "[" * 3000 + "]" * 3000, "{" * 2000, "[]", "{}", "true", "[nan]", "1979-05-27", "1e999"
    words[int(rng.integers(len(words)))] = str(pick(rng, (*NASTY, *many)))
    return " ".join(words)


def _encoded(text: str, rng: Rng) -> bytes:
    kinds = ("utf-8", "utf-8-sig", "utf-16", "utf-32", "latin-1", "crlf", "cr")
    kind = str(pick(rng, kinds))
    if kind in ("crlf", "cr"):
        return text.replace("\n", "\r\n" if kind == "crlf" else "\r").encode("utf-8", "replace")
    return text.encode(kind, "replace")


def text_file(raw: bytes, rng: Rng, suffix: str) -> bytes:
    """Change cells, rows, columns, words or the encoding; or just bytes."""
    if rng.random() < 0.2:
        return pick(rng, BYTES)(raw, rng)
    text = raw.decode("utf-8", "replace")
    separator = "," if "," in text else None
    kinds = (
        (_words, _words, _lines)
        if suffix in (".toml", ".json")
        else (_cell, _cell, _column, _lines)
    )
    for _ in range(int(rng.integers(1, 3))):
        text = pick(rng, kinds)(text, rng, separator)
    return text.encode("utf-8", "replace") if rng.random() < 0.8 else _encoded(text, rng)


def _clear(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def replace_file(path: Path, rng: Rng, secret: Path) -> None:
    """Put something that is no file of its own in the place of a file."""
    _clear(path)
    kind = int(rng.integers(7))
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        path.symlink_to(path.name)
    elif kind == 2:
        path.symlink_to("nowhere")
    elif kind == 3:
        path.symlink_to(secret)
    elif kind == 4:
        path.symlink_to("/dev/zero")
    elif kind == 5:
        os.mkfifo(path)


def restore(path: Path, raw: bytes) -> None:
    """Put a file back."""
    _clear(path)
    path.write_bytes(raw)
