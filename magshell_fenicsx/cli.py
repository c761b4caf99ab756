"""The command line; a thin user of the Python API, of which each command imports what it needs."""

import gc
import signal
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any

import typer

from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.platform.completion import case_files, left_to_the_shell
from magshell_fenicsx.platform.version import __version__

app = typer.Typer(
    help="Thin magnetic shells: deformation, indentation, buckling.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
CaseFile = Annotated[Path, typer.Argument(metavar="CASE.yaml", help="the case file", autocompletion=case_files)]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="replace a key of the case")
]

INVALID, STOPPED = 2, 3


def _folder(default: str) -> Any:
    return typer.Option(help=f"output folder; default {default}", autocompletion=left_to_the_shell)


def _world() -> Any:
    """All ranks."""
    from mpi4py import MPI

    return MPI.COMM_WORLD


def _say(line: str) -> None:
    if _world().rank == 0:
        print(line, flush=True)


def _failure(message: str, code: int) -> typer.Exit:
    if _world().rank:
        return typer.Exit()  # at the first rank that fails mpirun ends the job, and may lose the message
    print(message, file=sys.stderr, flush=True)
    return typer.Exit(code)


def main() -> None:
    """The program."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # of `| head`, say; PETSc would report a crash
    try:
        app(prog_name="magshell")  # by whatever name it was started: completion goes by it
    except Exception:
        if _world().size == 1:
            raise
        traceback.print_exc()
        sys.stderr.flush()
        _world().Abort(1)  # the other ranks would wait for this one for ever


def _tell_version(asked: bool) -> None:
    if asked:
        _say(f"magshell_fenicsx {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_tell_version, help="the version, and nothing else")
    ] = False,
) -> None:
    """Options before the command."""


@app.command()
def run(
    case: CaseFile,
    set_: Settings = None,
    out: Annotated[Path | None, _folder("results/<case name>/")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on with the run that was interrupted there")] = False,
    time_limit: Annotated[
        float | None, typer.Option(min=0, metavar="SECONDS", help="stop then, so that the run can be resumed")
    ] = None,
) -> None:
    """Solve a case and write path.csv, summary.json, fields and pictures."""
    from magshell_fenicsx.case.case import Case
    from magshell_fenicsx.mesh.patch import MeshError
    from magshell_fenicsx.output.store.folder import DiskError
    from magshell_fenicsx.platform.terminal import live_line
    from magshell_fenicsx.run.files import AlreadyComplete
    from magshell_fenicsx.run.run import run as run_case

    folder = out or Path("results") / case.stem
    try:
        read = Case.load(case, set_ or [])
        with live_line(_world().size, _say) as (say, tell):
            result = run_case(read, folder, say=say, tell=tell, resume=resume, time_limit=time_limit)
    except (CaseError, MeshError) as e:
        raise _failure(str(e), INVALID) from None
    except DiskError as e:
        raise _failure(f"stopped early: {e}", STOPPED) from None
    except AlreadyComplete as e:
        _say(f"complete already: {e.summary['points']} points; results in {folder}/")
        return
    gc.freeze()  # the process ends: to look for garbage once more takes longer than to import dolfinx
    if result.knockdown is not None:
        _say(f"knockdown factor k_d = {result.knockdown:.9g}")
    _say(f"results in {folder}/")
    if result.stopped:
        raise _failure(f"stopped early: {result.stopped}", STOPPED)


@app.command()
def sweep(
    case: CaseFile,
    over: Annotated[
        list[str],
        typer.Option(
            metavar="KEY.PATH=START:STOP:COUNT", help="or =VALUE,VALUE; repeat for a product, tie keys with +"
        ),
    ],
    set_: Settings = None,
    out: Annotated[Path | None, _folder("results/<case name>_sweep/")] = None,
    full_paths: Annotated[
        bool, typer.Option("--full-paths", help="a path of its own at every point; no fold is followed")
    ] = False,
) -> None:
    """Run a case over ranges of its keys; points that are in the folder already are kept."""
    from magshell_fenicsx.output.store.folder import DiskError
    from magshell_fenicsx.studies.sweep.sweep import sweep as run_sweep

    folder = out or Path("results") / f"{case.stem}_sweep"
    try:
        done = run_sweep(case, over, set_ or [], folder, full_paths=full_paths)
    except CaseError as e:
        raise _failure(str(e), INVALID) from None
    except DiskError as e:
        raise _failure(f"stopped early: {e}", STOPPED) from None
    _say(f"results in {folder}/")
    if done.stopped:
        raise _failure(f"{done.stopped} of {len(done.points)} points stopped early; sweep.csv says why", STOPPED)


@app.command()
def study(
    case: CaseFile,
    over: Annotated[
        list[str],
        typer.Option(
            metavar="KEY.PATH=VALUE,VALUE", help="or =START:STOP:COUNT; repeat for a product, tie keys with +"
        ),
    ],
    result: Annotated[
        str, typer.Option(metavar="NAME", help="knockdown, critical_field, force@w_over_h=10, energy@end, ...")
    ],
    set_: Settings = None,
    reference: Annotated[float | None, typer.Option(help="that errors are relative to; default the finest run")] = None,
    ranks: Annotated[str, typer.Option(metavar="N,N", help="numbers of MPI ranks to run each point on")] = "1",
    repeat: Annotated[int, typer.Option(min=1, help="runs of each point, whose medians are told")] = 3,
    out: Annotated[Path | None, _folder("results/<case name>_study/")] = None,
) -> None:
    """Measure error against run time over meshes, degrees, models and ranks; runs that are in the folder are kept."""
    from magshell_fenicsx.output.store.folder import DiskError
    from magshell_fenicsx.studies.study.study import parse_ranks
    from magshell_fenicsx.studies.study.study import study as run_study

    folder = out or Path("results") / f"{case.stem}_study"
    try:
        numbers, settings = parse_ranks(ranks), set_ or []
        done = run_study(
            case, over, settings, result=result, reference=reference, ranks=numbers, repeat=repeat, out=folder
        )
    except CaseError as e:
        raise _failure(str(e), INVALID) from None
    except DiskError as e:
        raise _failure(f"stopped early: {e}", STOPPED) from None
    _say(f"results in {folder}/")
    if done.without_result:
        raise _failure(f"{done.without_result} of {len(done.rows)} runs gave no {result}; study.csv says why", STOPPED)


@app.command()
def compare(
    case: CaseFile,
    set_: Settings = None,
    shell: Annotated[str, typer.Option(metavar="R,R", help="refinements of the shell's mesh; the finest counts")] = "1",
    solid: Annotated[str, typer.Option(metavar="R,R", help="of the solid's; three tell error against run time")] = "1",
    out: Annotated[Path | None, _folder("results/<case name>_compare/")] = None,
) -> None:
    """Run a case as a shell and as a solid; put curves, difference and run times side by side."""
    from magshell_fenicsx.output.store.folder import DiskError
    from magshell_fenicsx.studies.compare.compare import compare as run_comparison
    from magshell_fenicsx.studies.compare.compare import parse_refinements
    from magshell_fenicsx.studies.compare.runs import NothingLeft

    folder = out or Path("results") / f"{case.stem}_compare"
    try:
        refinements = parse_refinements(shell, solid)
        done = run_comparison(case, set_ or [], refinements=refinements, out=folder, say=_say)
    except CaseError as e:
        raise _failure(str(e), INVALID) from None
    except (DiskError, NothingLeft) as e:
        raise _failure(f"stopped early: {e}", STOPPED) from None
    difference = done.content["difference"]
    if difference is not None:
        _say(f"{done.content['result']}: the solid's is {100 * difference:+.3f} % from the shell's")
    _say(f"results in {folder}/")


@app.command()
def plot(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="a run's results, whole or interrupted", autocompletion=left_to_the_shell),
    ],
    point: Annotated[int | None, typer.Option(metavar="N", help="draw this point, as shell_000N.png, ...")] = None,
    animation: Annotated[bool, typer.Option("--animation", help="draw animation.gif too, of the path")] = False,
) -> None:
    """Make a run's pictures and report again, from its folder alone."""
    from magshell_fenicsx.output.pictures.plot import plot as plot_again
    from magshell_fenicsx.output.pictures.render import NoScreen

    if _world().rank:
        return
    try:
        drawn = plot_again(folder, point, animation)
    except CaseError as e:
        raise _failure(str(e), INVALID) from None
    except (NoScreen, OSError) as e:
        raise _failure(f"stopped early: {e}", STOPPED) from None
    _say(f"{', '.join(drawn)} in {folder}/")


@app.command()
def check(case: CaseFile, set_: Settings = None) -> None:
    """Validate a case; print what would be built and what is left out."""
    from magshell_fenicsx.case.case import Case
    from magshell_fenicsx.plan.check import describe

    try:
        _say(describe(Case.load(case, set_ or [])))
    except CaseError as e:
        raise _failure(str(e), INVALID) from None


def _names() -> list[str]:
    from magshell_fenicsx.case.examples import examples

    return list(examples())


@app.command()
def example(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="of the case to write", autocompletion=_names)
    ] = None,
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE.yaml", help="where to; default NAME.yaml", autocompletion=left_to_the_shell),
    ] = None,
) -> None:
    """Write an example case to a file, to run and to change; without NAME, list all of them."""
    from magshell_fenicsx.case.examples import examples, title, write_example

    if name is None:
        for known, where in examples().items():
            _say(f"{known:24} {title(where)}")
        return
    if _world().rank:
        return
    try:
        written = write_example(name, file)
    except CaseError as e:
        raise _failure(str(e), INVALID) from None
    _say(f"wrote {', '.join(map(str, written))}")


@app.command()
def schema(
    markdown: Annotated[bool, typer.Option("--markdown", help="as a page to read, docs/case.md")] = False,
) -> None:
    """The JSON Schema of the case file, for editors."""
    from magshell_fenicsx.case.reference import reference
    from magshell_fenicsx.case.schema import schema_text

    _say((reference() if markdown else schema_text()).removesuffix("\n"))


@app.command()
def info(
    compile_: Annotated[bool, typer.Option("--compile", help="compile every kernel of degrees 3 and 4 now")] = False,
) -> None:
    """Versions, the BLAS in use, the kernel cache."""
    from magshell_fenicsx.platform.environment import fast_blas, kernel_cache, versions
    from magshell_fenicsx.simulate.precompile import precompile

    for name, number in versions().items():
        _say(f"{name:18} {number}")
    _say(f"{'blas':18} {fast_blas() or 'reference (slow: install OpenBLAS)'}")
    _say(f"{'ranks':18} {_world().size}")
    _say(f"{'kernel cache':18} {kernel_cache()}")
    if compile_:
        for degree in (3, 4):
            _say(f"compiled degree {degree} in {precompile(degree):.1f} s")
