"""No function reaches for a name that its module lacks.

Linters cannot say it here: to them the shape strings of jaxtyping are undefined names too.
"""

import builtins
import dis
import importlib
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [
    path.relative_to(ROOT).as_posix()
    for room in ("taojax", "benchmarks")
    for path in sorted((ROOT / room).rglob("*.py"))
    if path.name != "__main__.py"
]


def missing(code: types.CodeType, known: set[str]) -> set[str]:
    """Return the global names that a code object and those inside it load in vain."""
    loads = ("LOAD_GLOBAL", "LOAD_NAME")
    found = {i.argval for i in dis.get_instructions(code) if i.opname in loads} - known
    # A class body reads what it has just defined.
    found -= {i.argval for i in dis.get_instructions(code) if i.opname == "STORE_NAME"}
    inner = (constant for constant in code.co_consts if isinstance(constant, types.CodeType))
    return found.union(*(missing(part, known) for part in inner))


@pytest.mark.parametrize("name", FILES)
def test_every_global_name_exists(name):
    code = compile((ROOT / name).read_text(encoding="utf-8"), name, "exec")
    dotted = name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    in_class = {"__module__", "__qualname__", "__annotations__"}
    known = set(vars(importlib.import_module(dotted))) | set(vars(builtins)) | in_class
    assert missing(code, known) == set()


def test_a_forgotten_import_is_found():
    code = compile("def f():\n    return [g(x) for x in y]\n", "f.py", "exec")
    assert missing(code, {"x"}) == {"g", "y"}
