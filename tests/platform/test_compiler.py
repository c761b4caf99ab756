"""Kernels that two processes want at the same time."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from magshell_fenicsx.platform import compiler


def test_one_compiles_and_the_others_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all that ask at once one is to compile; the others load what it makes, as a plain library."""
    monkeypatch.setattr(compiler, "_load_objects", lambda folder, module, names: (["loaded"], module))

    def ask(_: int) -> object:
        return compiler._get_cached_module("kernel", ["form"], tmp_path / "new", 20)

    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(ask, i) for i in range(4)]
        while not any(each.done() for each in asked):
            pass
        for made in ("kernel.so", "kernel.c.cached"):
            (tmp_path / "new" / made).touch()
        found = [each.result() for each in asked]
    assert found.count((None, None)) == 1
    assert found.count((["loaded"], "kernel")) == 3
