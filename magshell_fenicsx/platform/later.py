"""Packages that are imported where they are first used: a case that is refused does without UFL."""

import sys
from importlib.util import LazyLoader, find_spec, module_from_spec
from typing import Any


def later(name: str) -> Any:
    """A package that is imported when something of it is asked for, as `importlib` offers."""
    if name in sys.modules:
        return sys.modules[name]
    spec = find_spec(name)
    assert spec, name
    assert spec.loader, name
    spec.loader = LazyLoader(spec.loader)
    module = sys.modules[name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
