"""Commands that solve nothing.

They draw pictures and the report of a run, say what a case means, and print examples, the schema
and versions. Functions with `@app.command()` are commands; their docstrings are the help texts. An
option's name is that of its parameter.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from magshell_fenicsx.command import (
    CaseFile,
    Commands,
    Run,
    Runs,
    Settings,
    exit_codes,
    left_to_the_shell,
    picture_options,
    points_of,
    print_line,
    refuse_lost,
    typer,
)
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.platform.processes import world

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case

app = Commands()


@app.command()
def plot(  # noqa: PLR0913 - what a user gives
    folders: Runs,
    point: Annotated[
        int | None, typer.Option(metavar="N", help="draw only this point: shell_000N.png, ...")
    ] = None,
    animation: Annotated[
        bool, typer.Option("--animation", help="also draw the path: animation.gif")
    ] = False,
    shapes: Annotated[
        str | None, typer.Option(metavar="N,N", help="put these points' shells on the curve")
    ] = None,
    whole: Annotated[
        bool, typer.Option("--whole", help="also the whole shell of a half: fields/whole.pvd")
    ] = False,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="of several runs: where their curves go")
    ] = Path("curves.png"),
    formats: Annotated[
        str | None,
        typer.Option(metavar="KIND,KIND", help="besides png: svg, pdf, with text as text"),
    ] = None,
    width: Annotated[float | None, typer.Option(metavar="MM", help="of a picture")] = None,
    dpi: Annotated[int | None, typer.Option(help="pixels per inch")] = None,
    font_size: Annotated[float | None, typer.Option(metavar="POINTS", help="of all text")] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="POLAR,AZIMUTH", help="from the shell to the eye, degrees from e3 and e1"
        ),
    ] = None,
    range_: Annotated[
        list[str] | None,
        typer.Option(
            "--range", metavar="FIELD=LOW:HIGH", help="of colours, as w_over_h=-2:2; repeat"
        ),
    ] = None,
) -> None:
    """Draw the pictures and write the report of a run again, from its folder; of several runs their
    curves in one.
    """
    from magshell_fenicsx.output.pictures.plot import plot_folders

    if world().rank:  # rank 0 draws alone
        return
    with exit_codes(stopped=(OSError,)):
        options = picture_options(formats, width, dpi, font_size, camera, range_ or [])
        options |= {"whole": True} if whole else {}
        alone = {"point": point, "animation": animation, "shapes": points_of(shapes)}
        print_line(plot_folders(folders, out, options, **alone))


@app.command()
def view(folder: Run) -> None:
    """Open the report of a run in the web browser: the shell to turn, the path to walk along; else
    print its path.
    """
    from magshell_fenicsx.output.report.report import open_in_browser, report_of

    if world().rank:
        return
    with exit_codes(stopped=(OSError,)):
        file = report_of(folder)
    print_line(
        f"{'opened' if open_in_browser(file) else 'no web browser found; the report is'} {file}"
    )


@app.command()
def check(case: CaseFile, set_: Settings = None) -> None:
    """Validate a case; print what would be built and what is left out."""
    from magshell_fenicsx.case.case import Case
    from magshell_fenicsx.case.case_variants import read_together, with_same_files

    with exit_codes():
        source = read_together(case, world(), set_ or [])
        read_case = with_same_files(Case.from_source(source), world())
        # only now: the solver takes long to import
        from magshell_fenicsx.case.check import describe
        from magshell_fenicsx.case.open_problem import problem_of
        from magshell_fenicsx.simulate.perfect import with_modes

        problem = with_modes(problem_of(read_case, world()), world())
        print_line(describe(read_case, problem))
        if read_case.gradients or read_case.design:
            from magshell_fenicsx.simulate.gradients.results import refuse_unknown_results

            with placing_messages(read_case):
                refuse_unknown_results(
                    problem, read_case.design.named_results if read_case.design else {}
                )
        if read_case.ensemble:
            from magshell_fenicsx.studies.ensemble.samples import refuse_unknown_keys

            refuse_unknown_keys(source, read_case.ensemble, Case.from_source)
        if read_case.design:
            from magshell_fenicsx.studies.design.variables import refuse_unfit_numbers

            with placing_messages(read_case):
                refuse_unfit_numbers(source, read_case, read_case.design)
        if read_case.identify:
            from magshell_fenicsx.studies.identify.data import refuse_unfit_section
            from magshell_fenicsx.studies.identify.programme_input import refuse_unfit_programmes

            with placing_messages(read_case):
                refuse_unfit_section(source, read_case, read_case.identify)
                refuse_unfit_programmes(source, read_case, read_case.identify, Case.from_source)
    refuse_lost()


@contextmanager
def placing_messages(case: "Case") -> Iterator[None]:
    """Context in which messages of a `CaseError` get the place of their key in the case file."""
    try:
        yield
    except CaseError as e:
        raise CaseError(case.with_place(str(e))) from None


def _example_names() -> list[str]:
    """Return the names of the examples, for completion in the shell."""
    from magshell_fenicsx.case.examples import examples

    return list(examples())


@app.command()
def example(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="name of the example", autocompletion=_example_names),
    ] = None,
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="FILE.yaml",
            help="file to write; default NAME.yaml",
            autocompletion=left_to_the_shell,
        ),
    ] = None,
) -> None:
    """Write an example case to a file; without NAME, list all examples."""
    from magshell_fenicsx.case.examples import examples, title, write_example

    if name is None:
        for name_of_example, example_file in examples().items():
            print_line(f"{name_of_example:24} {title(example_file)}")
        refuse_lost()
        return
    if world().rank:
        return
    with exit_codes():
        files = write_example(name, file)
    print_line(f"wrote {', '.join(map(str, files))}")


@app.command()
def schema(
    markdown: Annotated[
        bool, typer.Option("--markdown", help="print the page docs/case.md instead")
    ] = False,
) -> None:
    """Print the JSON Schema of the case file, for editors."""
    from magshell_fenicsx.case.reference import reference, schema_text

    print_line((reference() if markdown else schema_text()).removesuffix("\n"))
    refuse_lost()


@app.command()
def info(
    compile_: Annotated[
        bool, typer.Option("--compile", help="compile the kernels of degrees 3 and 4 now")
    ] = False,
) -> None:
    """Print versions, the BLAS in use and the folder of the kernel cache."""
    from magshell_fenicsx.platform.disk_cache import cache_folder
    from magshell_fenicsx.platform.environment import fast_blas, versions
    from magshell_fenicsx.simulate.precompile import precompile

    with exit_codes():
        kernels = cache_folder()
    for name, number in versions().items():
        print_line(f"{name:18} {number}")
    print_line(f"{'blas':18} {fast_blas() or 'reference (slow: install OpenBLAS)'}")
    print_line(f"{'ranks':18} {world().size}")
    print_line(f"{'kernel cache':18} {kernels}")
    if compile_:
        from magshell_fenicsx.case.case import Case
        from magshell_fenicsx.output.pictures.rendering import library

        if not world().rank:
            library()
        for degree in (3, 4):
            seconds = precompile(degree, lambda source: Case.from_source(source).problem())
            print_line(f"compiled degree {degree} in {seconds:.1f} s")
    refuse_lost()
