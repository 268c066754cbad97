"""Every physical field says its unit and shape where it is declared (design.md, house rule 2).

The HDF5 fields have their own test beside the schema, `tests/data/test_schema.py`; here are the dataclasses of the
layers that hold physical quantities. A field is documented by the string literal below it.
"""

import ast
import re
from pathlib import Path

import pytest
from field_docs import fields_of

ROOT = Path(__file__).parents[1]
LAYERS = ("vsfsim/core", "vsfsim/data", "vsfsim/physics", "vsfsim/robot", "vsfsim/sensing", "vsfsim/vsf",
          "vsfsim/generate", "scenes")

SHAPE = re.compile(r"\(\w[\w\s+]*,")  # (n,), (T, 3), (3 n,), (T + 1,)
DIMENSIONLESS = ("relative", "fraction", "factor", "probability", " over ", "0..1", "0 to 1", "see `", "unit of the")
"""Words that stand for [-], or that send the reader to the class that says it."""


def undocumented(text: str) -> list[str]:
    """Fields of dataclasses in this module whose docstring names no shape (arrays) or no unit (numbers)."""
    out = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.ClassDef) or not any("dataclass" in ast.unparse(d) for d in node.decorator_list):
            continue
        # What the class says holds for all fields: "All (T, B).", "Lengths in metres."
        head = " ".join((ast.get_docstring(node) or "").split())
        for field in fields_of(node):
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
