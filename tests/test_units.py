"""Every physical field says its unit and shape where it is declared (design.md, house rule 2).

The HDF5 fields have their own test beside the schema, `tests/data/test_schema.py`; here are the dataclasses of the
layers that hold physical quantities. A field is documented by the string literal below it; until every layer is
rewritten so, an entry ``name: ...`` or ``one, two: ...`` in the docstring of the class is accepted as well.
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
        doc = " ".join((ast.get_docstring(node) or "").split())
        fields = fields_of(node)
        word = "(?:" + "|".join(f.name for f in fields) + ")" if fields else "(?!)"
        begin = rf"{word}(?:, {word})*:(?= )"  # of the entry of one field, or of some together
        # What stands before the first field holds for all of them: "All (T, B).", "Lengths in metres."
        head = re.split(rf"\b{begin}", doc, maxsplit=1)[0]
        for field in fields:
            array, number = "ndarray" in field.kind, bool(re.search(r"\bfloat\b", field.kind))
            if not (array or number) or re.match(r"(dict|Mapping)\b", field.kind):  # a mapping documents its keys
                continue
            entry = re.search(rf"(?:^|[ .,;]){field.name}(?:, {word})*: (.*?)(?= {begin}|$)", doc)
            text = field.doc or (entry[1] if entry else "")
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


@pytest.mark.parametrize(("points", "mass", "found"), [
    ("Nodes (n, 3) [m].", "[kg].", []),
    ("", "[kg].", ["Body.points: not documented"]),
    ("Nodes [m].", "[kg].", ["Body.points: no shape in 'Nodes [m].'"]),
    ("Nodes (n, 3) [m].", "How heavy it is.", ["Body.mass: no unit in 'How heavy it is.'"]),
    ("Nodes, see (the paper).", "[kg].", ["Body.points: no shape in 'Nodes, see (the paper).'"]),
])
def test_a_field_without_one_is_found(points, mass, found):
    below = [f'    """{doc}"""\n' if doc else "" for doc in (points, mass)]
    assert undocumented(f'@dataclass(frozen=True)\nclass Body:\n    """A body."""\n    points: np.ndarray\n{below[0]}'
                        f'    mass: float\n{below[1]}    name: str = ""\n') == found


@pytest.mark.parametrize(("doc", "found"), [
    ("A body. points: nodes (n, 3) [m]. mass: [kg].", []),
    ("A body.\n\n    mass, name: of it [kg]. points: (n, 3).", []),
    ("All (n, 3). points: nodes. mass: a fraction.", []),
    ("A body. mass: [kg].", ["Body.points: not documented"]),
    ("A body. points: nodes [m]. mass: [kg].", ["Body.points: no shape in 'nodes [m].'"]),
])
def test_a_field_without_one_is_found_in_a_paragraph(doc, found):
    text = (f'@dataclass(frozen=True)\nclass Body:\n    """{doc}"""\n    points: np.ndarray\n    mass: float\n    '
            f'name: str = ""\n')
    assert undocumented(text) == found
