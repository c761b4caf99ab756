"""The examples in docstrings give what stands below them."""

import doctest
from importlib import import_module
from pathlib import Path

import pytest

import magshell_fenicsx

PACKAGE = Path(magshell_fenicsx.__file__).parent
WITH_EXAMPLES = sorted(
    file for file in PACKAGE.rglob("*.py") if ">>> " in file.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("file", WITH_EXAMPLES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_examples(file: Path) -> None:
    name = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(
        ".__init__"
    )
    found = doctest.testmod(import_module(name))
    assert found.attempted
    assert not found.failed
