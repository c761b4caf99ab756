"""The whole deformed shell at a point, from the files of a run."""

from dataclasses import replace
from pathlib import Path

from magshell_fenicsx.output.fields.outlines import read_outlines
from magshell_fenicsx.output.fields.surface import Surface, completed
from magshell_fenicsx.output.fields.vtu import About, point_file, read_vtu


def read_point(folder: Path, number: int) -> tuple[Surface, About]:
    """The surface of a point in a folder of fields, with the outlines beside it; a half shell is completed."""
    surface, about = read_vtu(folder / point_file(number))
    surface = replace(surface, outlines=read_outlines(folder, number))
    return surface if about.mirror is None else completed(surface, about.mirror), about
