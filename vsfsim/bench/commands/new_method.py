"""`vsfsim lab new-method NAME`: a package with a method that runs, its entry point and its test."""

from __future__ import annotations

import re
from pathlib import Path

from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import METHOD_GROUP, methods
from vsfsim.data.disk import write_atomic

TEMPLATE = {"pyproject.toml": "project.txt", "{module}.py": "method.txt", "tests/test_{module}.py": "test.txt",
            "README.md": "readme.txt"}
"""Files of the package, each with its text in the folder ``template``."""


def write_package(name: str, out: Path | None = None) -> str:
    """Write the package of a new method.

    Args:
        name: of the method.
        out: folder to make, or None for ``name`` in the current one.

    Returns:
        What was written and the next steps, to be printed.

    Raises:
        MethodError: the name cannot be that of a method and a package, it is taken, or the folder is not empty.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise MethodError(f"the name of a method is {name!r}; give small letters, digits and single dashes that begin "
                          f"with a letter, e.g. my-method.")
    if name in methods():
        raise MethodError(f"there is a method '{name}' already ({methods()[name].value}). Choose another name.")
    folder = out or Path(name)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise MethodError(f"'{folder}' exists and is {'not empty' if folder.is_dir() else 'a file'}. Choose another "
                          f"place by --out, or remove it.")
    words = name.split("-")
    module = "_".join(words)
    values = {"name": name, "module": module, "group": METHOD_GROUP, "classname": "".join(w.title() for w in words)}
    for path, template in TEMPLATE.items():
        file = folder / path.format(**values)
        text = (Path(__file__).parent / "template" / template).read_text(encoding="utf-8")
        write_atomic(file, text.format(**values).encode(), error=MethodError)
    return (f"written to {folder}: {module}.py (the method), its test, pyproject.toml with the entry point\n\n"
            f"  cd {folder}\n  vsfsim check {module}:{values['classname']}    # before it is installed\n"
            f"  pip install -e \".[test]\" && pytest\n"
            f"  vsfsim evaluate --method {name} --task fewshot-shoes-v3-mini-v1")
