"""Reads the documentation of a dataclass's fields from its source: the string literal below each field."""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import NamedTuple


class Field(NamedTuple):
    """A field of a dataclass, as it is declared."""

    name: str
    """Its name."""
    kind: str
    """Its annotation, as source text."""
    doc: str
    """The string literal below it on one line; empty if there is none."""


def fields_of(node: ast.ClassDef) -> list[Field]:
    """The public fields of a class, in order."""
    out = []
    for statement, following in zip(node.body, [*node.body[1:], ast.Pass()], strict=True):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        literal = (following.value.value if isinstance(following, ast.Expr)
                   and isinstance(following.value, ast.Constant) else None)
        if not statement.target.id.startswith("_"):
            out.append(Field(statement.target.id, ast.unparse(statement.annotation),
                             " ".join(literal.split()) if isinstance(literal, str) else ""))
    return out


def docs_of(record: type) -> dict[str, str]:
    """The documentation of each field of a class, by the field's name."""
    [node] = ast.parse(textwrap.dedent(inspect.getsource(record))).body
    assert isinstance(node, ast.ClassDef)
    return {field.name: field.doc for field in fields_of(node)}
