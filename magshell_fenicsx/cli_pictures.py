"""The commands `plot` and `view` of the command line."""

from pathlib import Path
from typing import Annotated

from magshell_fenicsx.ending import exit_codes, print_line, world
from magshell_fenicsx.platform.completion import left_to_the_shell
from magshell_fenicsx.platform.plain import typer

Run = Annotated[
    Path,
    typer.Argument(metavar="DIR", help="folder of a finished or interrupted run", autocompletion=left_to_the_shell),
]


def plot(
    folder: Run,
    point: Annotated[int | None, typer.Option(metavar="N", help="draw only this point: shell_000N.png, ...")] = None,
    animation: Annotated[bool, typer.Option("--animation", help="also draw the path: animation.gif")] = False,
    formats: Annotated[
        str | None, typer.Option(metavar="KIND,KIND", help="besides png: svg, pdf, with text as text")
    ] = None,
    width: Annotated[float | None, typer.Option(metavar="MM", help="of a picture")] = None,
    dpi: Annotated[int | None, typer.Option(help="pixels per inch")] = None,
    font_size: Annotated[float | None, typer.Option(metavar="POINTS", help="of all text")] = None,
    camera: Annotated[
        str | None, typer.Option(metavar="POLAR,AZIMUTH", help="from the shell to the eye, degrees from e3 and e1")
    ] = None,
    range_: Annotated[
        list[str] | None, typer.Option("--range", metavar="FIELD=LOW:HIGH", help="of colours, as w_over_h=-2:2; repeat")
    ] = None,
) -> None:
    """Draw the pictures and write the report of a run again, from its folder; options as in the section output."""
    from magshell_fenicsx.case.options import plot_options
    from magshell_fenicsx.output.pictures.plot import plot as plot_again

    if world().rank:
        return
    with exit_codes(stopped=(OSError,)):
        options = plot_options(formats, width, dpi, font_size, camera, range_ or [])
        drawn = plot_again(folder, point, animation, options)
    print_line(f"{', '.join(drawn)} in {folder}/")


def view(folder: Run) -> None:
    """Open the report of a run in the web browser: the shell to turn, the path to walk along; else print its path."""
    from magshell_fenicsx.output.report.report import opened, report_of

    if world().rank:
        return
    with exit_codes(stopped=(OSError,)):
        file = report_of(folder)
    print_line(f"{'opened' if opened(file) else 'no web browser found; the report is'} {file}")
