"""Reads the documentation of a dataclass's fields from its source: the string literal below each field, or what its
row of the schema says (`vsfsim.data.records.Row`)."""

from __future__ import annotations

import ast
from typing import NamedTuple


class Field(NamedTuple):
    """A field of a dataclass, as it is declared."""

    name: str
    """Its name."""
    kind: str
    """Its annotation, as source text."""
    doc: str
    """The string literal below it on one line, or sentence, shape and unit of its row; empty if there is neither."""


def fields_of(node: ast.ClassDef) -> list[Field]:
    """The public fields of a class, in order."""
    out = []
    for statement, following in zip(node.body, [*node.body[1:], ast.Pass()], strict=True):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        literal = (following.value.value if isinstance(following, ast.Expr)
                   and isinstance(following.value, ast.Constant) else None)
        rows = [call for call in ast.walk(statement.annotation) if isinstance(call, ast.Call)]
        if rows:
            _, dims, unit, sentence = (ast.literal_eval(value) for value in rows[0].args)
            literal = f"{sentence} ({', '.join(dims.split())},) [{unit}]"
        if not statement.target.id.startswith("_"):
            out.append(Field(statement.target.id, ast.unparse(statement.annotation),
                             " ".join(literal.split()) if isinstance(literal, str) else ""))
    return out
