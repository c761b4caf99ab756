"""Import of packages at their first use: a case that is refused does without UFL."""

import sys
from importlib.util import LazyLoader, find_spec, module_from_spec
from typing import Any


def lazy_import(name: str) -> Any:
    """Return a package that is only imported when one of its attributes is first read."""
    if name in sys.modules:  # imported already, or lazily before
        return sys.modules[name]
    spec = find_spec(name)
    assert spec, name
    assert spec.loader, name
    spec.loader = LazyLoader(spec.loader)
    module = sys.modules[name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
