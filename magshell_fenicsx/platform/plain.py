"""Typer, without rich where no help is asked for: the import of rich takes 0.15 s of every command."""

import sys

_absent = "rich" not in sys.modules and "--help" not in sys.argv and len(sys.argv) > 1
if _absent:
    sys.modules["rich"] = None  # type: ignore[assignment]  # an import of it fails, as where it is not installed
try:
    import typer
finally:
    if _absent:
        del sys.modules["rich"]

__all__ = ["typer"]
