"""Every physical field says its unit and shape where it is declared (design.md, house rule 2).

The HDF5 fields have their own test beside the schema, `tests/data/test_schema.py`; here are the dataclasses of the
layers that hold physical quantities. A field is documented by the string literal below it, or by a comment beside it.
"""

import ast
import re
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = ("vsfsim/core", "vsfsim/data", "vsfsim/physics", "vsfsim/robot", "vsfsim/sensing", "vsfsim/vsf",
          "vsfsim/generate", "scenes")

SHAPE = re.compile(r"\(\w[\w\s+]*,")  # (n,), (T, 3), (3 n,), (T + 1,)
DIMENSIONLESS = ("relative", "fraction", "factor", "probability", " over ", "0..1", "0 to 1", "see `", "unit of the")
"""Words that stand for [-], or that send the reader to the class that says it."""


class Field(NamedTuple):
    """A field of a dataclass, as it is declared."""

    name: str
    """Its name."""
    kind: str
    """Its annotation, as source text."""
    doc: str
    """The string literal below it on one line, or the comment beside it, which `tests/data/test_schema.py` compares
    with the schema; empty if there is neither."""


def fields_of(node: ast.ClassDef, lines: list[str]) -> list[Field]:
    """The public fields of a class, in order; ``lines`` are those of its module."""
    out = []
    for statement, following in zip(node.body, [*node.body[1:], ast.Pass()], strict=True):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        literal = (following.value.value if isinstance(following, ast.Expr)
                   and isinstance(following.value, ast.Constant) else None)
        if not isinstance(literal, str):
            literal = lines[statement.lineno - 1].partition("  # ")[2]
        if not statement.target.id.startswith("_"):
            out.append(Field(statement.target.id, ast.unparse(statement.annotation),
                             " ".join(literal.split())))
    return out


def undocumented(text: str) -> list[str]:
    """Fields of dataclasses in this module whose docstring names no shape (arrays) or no unit (numbers)."""
    out, lines = [], text.splitlines()
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.ClassDef) or not any("dataclass" in ast.unparse(d) for d in node.decorator_list):
            continue
        # What the class says holds for all fields: "All (T, B).", "Lengths in metres."
        head = " ".join((ast.get_docstring(node) or "").split())
        for field in fields_of(node, lines):
            array, number = "ndarray" in field.kind, bool(re.search(r"\bfloat\b", field.kind))
            if not (array or number) or re.match(r"(dict|Mapping)\b", field.kind):  # a mapping documents its keys
                continue
            text = field.doc
            if not text:
                out.append(f"{node.name}.{field.name}: not documented")
            elif array and not SHAPE.search(text + head):
                out.append(f"{node.name}.{field.name}: no shape in '{text}'")
            elif (number and "[" not in text and "metres" not in head
                  and not any(word in f" {text.lower()} " for word in DIMENSIONLESS)):
                out.append(f"{node.name}.{field.name}: no unit in '{text}'")
    return out


@pytest.mark.parametrize("layer", LAYERS)
def test_fields_say_unit_and_shape(layer):
    found = {str(p.relative_to(ROOT)): undocumented(p.read_text()) for p in sorted((ROOT / layer).rglob("*.py"))}
    assert {path: problems for path, problems in found.items() if problems} == {}
