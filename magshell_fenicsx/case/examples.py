"""The example cases.

They are beside the package in the repository, and inside it where it is installed.
"""

from pathlib import Path

from magshell_fenicsx.input.source import CaseError, read_source

PACKAGE = Path(__file__).parents[1]
INSTALLED = PACKAGE / "examples"  # made by setup.py
CASES = (INSTALLED if INSTALLED.is_dir() else PACKAGE.parent) / "cases"
# begin of a line for editors: its path leads to the schema from the folder of cases alone
EDITOR_LINE = "# yaml-language-server:"


def examples() -> dict[str, Path]:
    """Return name -> case file of all examples, the benchmarks last."""
    files = [*sorted(CASES.glob("*.yaml")), *sorted(CASES.glob("benchmarks/*.yaml"))]
    return {file.stem: file for file in files}


def title(file: Path) -> str:
    """Return the title of a case file: the first line of its comment, up to a colon."""
    comment = _text(file).partition("\n")[0].removeprefix("# ")
    # a space, so that a colon at the end of the line counts too
    return (comment + " ").partition(": ")[0].strip().removesuffix(".")


def write_example(name: str, file: Path | None = None) -> list[Path]:
    """Write an example case to a file, with the files that it names beside it.

    Parameters
    ----------
    name
        Name of the example: that of its file, without the ending.
    file
        File to write; by default NAME.yaml in the working folder.

    Returns
    -------
    The files that were written.

    Raises
    ------
    CaseError
        If there is no such example, or a file cannot be written or would be overwritten.
    """
    example_files = examples()
    if name not in example_files:
        raise CaseError(f"example {name}: there is no such case, only {', '.join(example_files)}")
    target = file or Path(f"{name}.yaml")
    try:
        return _write_files(_contents(example_files[name], target), target)
    except OSError as e:
        raise CaseError(f"{e.filename or target}: cannot be written: {e.strerror}") from None


def _text(file: Path) -> str:
    """Return the text of a case file without its line for editors."""
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith(EDITOR_LINE))


def _contents(source: Path, target: Path) -> dict[Path, bytes]:
    """Return path -> content of the files of an example.

    They are the case, and its mesh file or data file. An example of `identify` may name further
    cases with their data, below `predict`; these come too.

    Parameters
    ----------
    source
        The example's case file.
    target
        Path of the case to be written; other files are beside it.
    """
    text, case_data = _text(source), read_source(source).data
    mesh = (case_data.get("shell") or {}).get("file")  # name of a mesh file, or None
    data_file = source.with_suffix(".csv")
    # only an example of `identify` has data: a table with the example's name
    if data_file.exists():
        predicted = (case_data.get("identify") or {}).get("predict") or {}
        names = list[str]()
        for prediction in predicted.values():
            names += [prediction[key] for key in ("case", "data") if key in prediction]
        other_files = {target.parent / file: _text(source.parent / file).encode() for file in names}
        return {
            target: text.encode(),
            target.with_suffix(".csv"): data_file.read_bytes(),
            **other_files,
        }
    if mesh is None:
        return {target: text.encode()}
    mesh_name = Path(mesh).name  # the example names it in another folder, the copy beside itself
    return {
        target: text.replace(mesh, mesh_name).encode(),
        target.parent / mesh_name: (source.parent / mesh).read_bytes(),
    }


def _write_files(contents: dict[Path, bytes], target: Path) -> list[Path]:
    """Write files if none is in the way, and return their paths.

    A file with the same content may be there already, such as the mesh of another copy of the case.
    Raises CaseError before anything is written.
    """
    for path, content in contents.items():
        if not path.exists():
            continue
        if path == target or path.read_bytes() != content:
            raise CaseError(f"{path}: is there already, and is kept; name a file elsewhere")
    for path, content in contents.items():
        if not path.exists():
            path.write_bytes(content)
    return list(contents)
