"""Files of gradients by fields: the deformed shell with dJ per area as its fields."""

from pathlib import Path

PREFIX = "gradients_"
CURVATURES = ("curvature_11", "curvature_22", "curvature_12")


def columns_of(by: str) -> tuple[str, ...]:
    """The names in the file of a field's gradient; that of the remanence is a vector."""
    return CURVATURES if by == "curvature" else (by,)


def gradient_file(folder: Path, of: str) -> Path:
    """The file of a result's gradients.

    Examples
    --------
    >>> gradient_file(Path("out"), "knockdown").as_posix()
    'out/fields/gradients_knockdown.vtu'
    """
    return folder / "fields" / f"{PREFIX}{of}.vtu"


def gradient_files(folder: Path) -> dict[str, Path]:
    """Result -> file of those in a folder."""
    return {file.stem.removeprefix(PREFIX): file for file in sorted((folder / "fields").glob(f"{PREFIX}*.vtu"))}
