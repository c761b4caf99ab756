"""The example cases, which stand beside the package in the repository and inside it where it is
installed.
"""

from pathlib import Path

from magshell_fenicsx.input.source import CaseError, read_source

PACKAGE = Path(__file__).parents[1]
INSTALLED = PACKAGE / "examples"  # made by setup.py
CASES = (INSTALLED if INSTALLED.is_dir() else PACKAGE.parent) / "cases"
FOR_EDITORS = (
    "# yaml-language-server:"  # its path leads to the schema from the folder of cases alone
)


def examples() -> dict[str, Path]:
    """Name -> file, the benchmarks last."""
    files = [*sorted(CASES.glob("*.yaml")), *sorted(CASES.glob("benchmarks/*.yaml"))]
    return {file.stem: file for file in files}


def title(file: Path) -> str:
    """What a case is of: the first line of its comment, up to a colon."""
    comment = _text(file).partition("\n")[0].removeprefix("# ")
    return (comment + " ").partition(": ")[0].strip().removesuffix(".")


def write_example(name: str, file: Path | None = None) -> list[Path]:
    """Write an example to a file, by default NAME.yaml, and its mesh beside it; which files these
    are.

    Raises
    ------
    CaseError
        If there is no such example, or a file cannot be written or would be overwritten.
    """
    of_package = examples()
    if name not in of_package:
        raise CaseError(f"example {name}: there is no such case, only {', '.join(of_package)}")
    target = file or Path(f"{name}.yaml")
    try:
        return _written(_contents(of_package[name], target), target)
    except OSError as e:
        raise CaseError(f"{e.filename or target}: cannot be written: {e.strerror}") from None


def _text(file: Path) -> str:
    """A case without its line for editors."""
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith(FOR_EDITORS))


def _contents(source: Path, target: Path) -> dict[Path, bytes]:
    """The case, and the mesh file that it names or the data of its name, which come to stand beside
    it.

    So do the cases and data that it predicts.
    """
    text, given = _text(source), read_source(source).data
    mesh, data = (given.get("shell") or {}).get("file"), source.with_suffix(".csv")
    if data.exists():
        predicted = (given.get("identify") or {}).get("predict") or {}
        named = [each[of] for each in predicted.values() for of in ("case", "data") if of in each]
        others = {target.parent / file: _text(source.parent / file).encode() for file in named}
        return {target: text.encode(), target.with_suffix(".csv"): data.read_bytes(), **others}
    if mesh is None:
        return {target: text.encode()}
    beside = Path(mesh).name
    return {
        target: text.replace(mesh, beside).encode(),
        target.parent / beside: (source.parent / mesh).read_bytes(),
    }


def _written(contents: dict[Path, bytes], target: Path) -> list[Path]:
    """Write the files if none is in the way; the mesh of another copy of the case serves this one
    too.
    """
    for path, content in contents.items():
        if path.exists() and (path == target or path.read_bytes() != content):
            raise CaseError(f"{path}: is there already, and is kept; name a file elsewhere")
    for path, content in contents.items():
        if not path.exists():
            path.write_bytes(content)
    return list(contents)
