"""Every physical field says its unit and shape where it is declared (design.md, house rule 2).

The HDF5 fields have their own test beside the schema, `tests/data/test_schema.py`; here are the dataclasses of the
layers that hold physical quantities. A docstring speaks of a field as ``name: ...`` or ``one, two: ...``.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = ("vsfsim/core", "vsfsim/data", "vsfsim/physics", "vsfsim/robot", "vsfsim/sensing", "vsfsim/vsf",
          "vsfsim/generate", "scenes")

SHAPE = re.compile(r"\(\w[\w\s+]*,")  # (n,), (T, 3), (3 n,), (T + 1,)
DIMENSIONLESS = ("relative", "fraction", "factor", "probability", " over ", "0..1", "see `")
"""Words that stand for [-], or that send the reader to the class that says it."""


def undocumented(text: str) -> list[str]:
    """Fields of dataclasses in this module whose docstring names no shape (arrays) or no unit (numbers)."""
    out = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.ClassDef) or not any("dataclass" in ast.unparse(d) for d in node.decorator_list):
            continue
        doc = " ".join((ast.get_docstring(node) or "").split())
        fields = [f for f in node.body if isinstance(f, ast.AnnAssign) and isinstance(f.target, ast.Name)
                  and not f.target.id.startswith("_")]
        word = "(?:" + "|".join(f.target.id for f in fields) + ")" if fields else "(?!)"
        begin = rf"{word}(?:, {word})*:(?= )"  # of the entry of one field, or of some together
        # what stands before the first field holds for all of them: "All (T, B).", "Lengths in metres."
        head = re.split(rf"\b{begin}", doc, maxsplit=1)[0]
        for field in fields:
            name, kind = field.target.id, ast.unparse(field.annotation)
            array, number = "ndarray" in kind, bool(re.search(r"\bfloat\b", kind))
            if not (array or number):
                continue
            entry = re.search(rf"(?:^|[ .,;]){name}(?:, {word})*: (.*?)(?= {begin}|$)", doc)
            if entry is None:
                out.append(f"{node.name}.{name}: not in the docstring")
            elif array and not SHAPE.search(entry[1] + head):
                out.append(f"{node.name}.{name}: no shape in '{entry[1]}'")
            elif (number and "[" not in entry[1] and "metres" not in head
                  and not any(word in f" {entry[1]} " for word in DIMENSIONLESS)):
                out.append(f"{node.name}.{name}: no unit in '{entry[1]}'")
    return out


@pytest.mark.parametrize("layer", LAYERS)
def test_fields_say_unit_and_shape(layer):
    found = {str(p.relative_to(ROOT)): undocumented(p.read_text()) for p in sorted((ROOT / layer).rglob("*.py"))}
    assert {path: problems for path, problems in found.items() if problems} == {}


@pytest.mark.parametrize(("doc", "found"), [
    ("A body. points: nodes (n, 3) [m]. mass: [kg].", []),
    ("A body.\n\n    mass, name: of it [kg]. points: (n, 3).", []),
    ("All (n, 3). points: nodes. mass: a fraction.", []),
    ("A body. mass: [kg].", ["Body.points: not in the docstring"]),
    ("A body. points: nodes [m]. mass: [kg].", ["Body.points: no shape in 'nodes [m].'"]),
    ("A body. points: nodes (n, 3) [m]. mass: how heavy it is.", ["Body.mass: no unit in 'how heavy it is.'"]),
    ("A body, see (the paper). points: nodes. mass: [kg].", ["Body.points: no shape in 'nodes.'"]),
])
def test_a_field_without_one_is_found(doc, found):
    text = (f'@dataclass(frozen=True)\nclass Body:\n    """{doc}"""\n    points: np.ndarray\n    mass: float\n    '
            f'name: str = ""\n')
    assert undocumented(text) == found
