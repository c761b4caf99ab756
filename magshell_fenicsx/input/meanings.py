"""What the docstrings of keys say. Python does not keep them: they are read in the source when somebody asks."""

import ast
import inspect
import sys
from functools import cache

from pydantic import BaseModel


def meaning(section: type[BaseModel], key: str) -> str:
    """The docstring of a key of a section or its base, or what stands in its place; empty without."""
    field = section.model_fields.get(key)
    if field is not None and field.description:
        return field.description
    return next((found for base in section.__mro__ if (found := _docstrings(base).get(key))), "")


@cache
def _docstrings(section: type) -> dict[str, str]:
    """Key -> docstring of a class's own keys."""
    own = _classes(section.__module__).get(section.__qualname__) if issubclass(section, BaseModel) else None
    pairs = zip(own.body, own.body[1:], strict=False) if own else ()
    return {
        key.target.id: inspect.cleandoc(text.value.value)
        for key, text in pairs
        if isinstance(key, ast.AnnAssign) and isinstance(key.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
    }


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """Name -> class at the top of a module that has a source."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
