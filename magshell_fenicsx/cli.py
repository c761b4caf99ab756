"""The command line: a thin layer over the Python API. Each command imports only what it needs."""

import gc
import os
import signal
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any

from magshell_fenicsx import inspection
from magshell_fenicsx.command import (
    INVALID,
    STOPPED,
    CaseFile,
    Commands,
    Jobs,
    Over,
    Result,
    Settings,
    chosen_folder,
    exit_codes,
    failure,
    folder_option,
    print_line,
    result_option,
    study_folder,
    typer,
)
from magshell_fenicsx.platform.interrupt import INTERRUPTED, is_interrupt
from magshell_fenicsx.platform.packages import Unusable, install_hint
from magshell_fenicsx.platform.processes import world
from magshell_fenicsx.platform.terminal import open_standard_streams
from magshell_fenicsx.platform.version import __version__

app = Commands(
    help="Thin magnetic shells: deformation, indentation, buckling.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
PETSC_PREFIXES = (
    "-snes_",
    "-ksp_",
    "-mat_",
    "-magshell_",
    "-log_",
    "-options_",
)  # how its options begin


def _hand_over_to_petsc(words: list[str]) -> None:
    """Take PETSc's options off the words of a command; changes `words`.

    They come last in a command. PETSc reads them from the environment when it is imported.
    """
    first_option = next(
        (i for i, word in enumerate(words) if word.startswith(PETSC_PREFIXES)), len(words)
    )
    # a word of the program behind them would be lost
    for word in words[first_option:]:
        if word.startswith("--") or word.endswith((".yaml", ".yml")):
            sys.exit(
                failure(
                    f"{word} comes after {words[first_option]}: options of PETSc come last", INVALID
                ).exit_code
            )
    if words[first_option:]:
        os.environ["PETSC_OPTIONS"] = " ".join(
            [os.environ.get("PETSC_OPTIONS", ""), *words[first_option:]]
        )
    del words[first_option:]


def case_of_source(source: Any) -> Any:
    """Return the case of a source."""
    from magshell_fenicsx.case.case import Case

    return Case.from_source(source)


def shared_case_of_source(source: Any) -> Any:
    """Return the case of a source on all ranks, which share its files; collective."""
    from magshell_fenicsx.case.case_variants import with_same_files

    return with_same_files(case_of_source(source), world())


def main() -> None:
    """Run the program."""
    open_standard_streams()
    # PETSc's signal handler would report a crash
    os.environ["PETSC_OPTIONS"] = f"-no_signal_handler {os.environ.get('PETSC_OPTIONS', '')}"
    _hand_over_to_petsc(sys.argv)
    # with these thresholds a small run collects no garbage; with Python's own ones it would do so
    # two hundred times
    gc.set_threshold(300_000, 5, 5)
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # sent by `magshell ... | head`
    try:
        app(prog_name="magshell")  # the same name however it was started: completion depends on it
    except Exception as e:
        if is_interrupt(e):
            sys.exit(INTERRUPTED)
        if isinstance(e, ImportError) and (advice := install_hint(e)):
            print(advice, file=sys.stderr)
            sys.exit(INVALID)
        if isinstance(e, Unusable):
            sys.exit(failure(str(e), INVALID).exit_code)
        if world().size == 1:
            raise
        traceback.print_exc()
        sys.stderr.flush()
        world().Abort(1)  # the other ranks would wait for this one for ever


def _print_version(requested: bool) -> None:
    """Print the version and end the program, if that is requested."""
    if requested:
        print_line(f"magshell_fenicsx {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="print the version and exit"
        ),
    ] = False,
) -> None:
    """Options before the command."""


@app.command()
def run(
    case: CaseFile,
    set_: Settings = None,
    out: Annotated[str | None, folder_option("results/<case name>/")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="continue the interrupted run in that folder")
    ] = False,
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite",
            help="replace the run in that folder even if it is another's, or unfinished",
        ),
    ] = False,
    time_limit: Annotated[
        float | None, typer.Option(min=0, metavar="SECONDS", help="stop then; resumable")
    ] = None,
    pictures: Annotated[
        bool, typer.Option(" /--no-pictures", show_default=False, help="plot draws them later")
    ] = True,
) -> None:
    """Solve a case and write path.csv, summary.json, fields and pictures."""
    from magshell_fenicsx.case.case_variants import open_case

    folder = chosen_folder(out, case.stem)
    how: dict[str, Any] = {
        "resume": resume,
        "overwrite": overwrite,
        "time_limit": time_limit,
        "pictures": pictures,
    }
    with exit_codes():
        read = open_case(case, world(), set_ or [])
    # a refused case does not import what solves
    from magshell_fenicsx.output.report.verdict import sentence_of
    from magshell_fenicsx.output.store.folder import DiskError
    from magshell_fenicsx.platform.terminal import live_line
    from magshell_fenicsx.public import run as run_case
    from magshell_fenicsx.quantities.quantity import number_with_error
    from magshell_fenicsx.runs.files import AlreadyComplete

    gc.freeze()  # what is imported stays
    try:
        with exit_codes(stopped=(DiskError,)), live_line(world().size, print_line) as (say, tell):
            result = run_case(read, folder, say=say, tell=tell, **how)
    except AlreadyComplete as e:
        print_line(f"complete already: {e.summary['points']} points; results in {folder}/")
        print_line(sentence_of(folder))
        return
    # the process ends soon: another garbage collection takes longer than importing dolfinx
    gc.freeze()
    if result.knockdown is not None:
        k_d = number_with_error(result.knockdown, result.errors.get("knockdown"))
        print_line(f"knockdown factor k_d = {k_d}")
    if result.barrier is not None:
        barrier = number_with_error(result.barrier, result.errors.get("barrier"))
        print_line(f"energy barrier = {barrier} E h R^2")
    print_line(f"results in {folder}/")
    if result.stopped:
        for remark in result.remarks:
            print_line(f"warning: {remark}")
        raise failure(f"stopped early: {result.stopped}", STOPPED)
    if world().rank == 0:
        print_line(sentence_of(folder))


@app.command()
def sweep(
    case: CaseFile,
    over: Over,
    set_: Settings = None,
    out: Annotated[str | None, folder_option("results/<case name>_sweep/")] = None,
    result: Annotated[str | None, result_option("beside k_d, barrier and limit points: ")] = None,
    full_paths: Annotated[
        bool,
        typer.Option("--full-paths", help="compute the full path at every point; follow no fold"),
    ] = False,
    jobs: Jobs = 1,
    part: Annotated[
        str | None,
        typer.Option(
            metavar="I/N", help="compute only the I-th of N shares of the points: one of N jobs"
        ),
    ] = None,
) -> None:
    """Run a case over ranges of its keys; keep the points that are already in the folder."""
    from magshell_fenicsx.studies.runner import local_processes
    from magshell_fenicsx.studies.sweep.sweep import sweep as run_sweep

    with (
        study_folder(out, f"{case.stem}_sweep") as folder,
        local_processes(jobs) as executor,
    ):
        outcome = run_sweep(
            case,
            over,
            set_ or [],
            folder,
            make_case=case_of_source,
            result=result,
            full_paths=full_paths,
            part=part,
            executor=executor,
        )
    if outcome.stopped:
        raise failure(
            f"{outcome.stopped} of {len(outcome.points)} points stopped early; sweep.csv says why",
            STOPPED,
        )
    if without := outcome.results.count(None):
        raise failure(
            f"{without} of {len(outcome.points)} points gave no {result}; sweep.csv says why",
            STOPPED,
        )


@app.command()
def boundary(
    case: CaseFile,
    over: Annotated[
        list[str],
        typer.Option(
            metavar="KEY=A:B",
            help="the key that varies, and its range; A:B:STEPS is finer; a second one, "
            "KEY=A:B:COUNT, makes a map",
        ),
    ],
    from_: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="DIR:POINT",
            help="start at another fold or bifurcation: a point of the path.csv of a run",
        ),
    ] = None,
    set_: Settings = None,
    out: Annotated[str | None, folder_option("results/<case name>_boundary/")] = None,
) -> None:
    """Follow the fold or bifurcation at the end of a case in a second key, through cusps; keep
    points in the folder.
    """
    from magshell_fenicsx.simulate.record import Stopped
    from magshell_fenicsx.studies.boundary.stability_map import boundary_map

    with study_folder(out, f"{case.stem}_boundary", Stopped) as folder:
        outcome = boundary_map(
            case, over, set_ or [], folder, make_case=case_of_source, start=from_
        )
    if outcome.stopped:
        raise failure(f"stopped early: {'; '.join(outcome.stopped)}", STOPPED)


@app.command()
def study(
    case: CaseFile,
    over: Over,
    result: Result,
    set_: Settings = None,
    reference: Annotated[
        float | None, typer.Option(help="exact value for the errors; default the finest run")
    ] = None,
    ranks: Annotated[
        str, typer.Option(metavar="N,N", help="numbers of MPI ranks for each point")
    ] = "1",
    repeat: Annotated[
        int, typer.Option(min=1, help="runs of each point; medians are reported")
    ] = 3,
    out: Annotated[str | None, folder_option("results/<case name>_study/")] = None,
) -> None:
    """Measure error against run time over meshes, degrees, models and ranks; keep the runs in the
    folder.
    """
    from magshell_fenicsx.studies.study.study import parse_ranks
    from magshell_fenicsx.studies.study.study import study as run_study

    with study_folder(out, f"{case.stem}_study") as folder:
        outcome = run_study(
            case,
            over,
            set_ or [],
            result=result,
            make_case=case_of_source,
            reference=reference,
            ranks=parse_ranks(ranks),
            repeat=repeat,
            out=folder,
        )
    if outcome.without_result:
        raise failure(
            f"{outcome.without_result} of {len(outcome.rows)} runs gave no {result}; "
            "study.csv says why",
            STOPPED,
        )


@app.command()
def ensemble(  # noqa: PLR0913 - what a user gives
    case: CaseFile,
    samples: Annotated[int, typer.Option(min=1, metavar="N", help="number of samples")],
    seed: Annotated[
        int,
        typer.Option(min=0, metavar="S", help="of the random numbers; sample k depends on S and k"),
    ],
    set_: Settings = None,
    result: Result = "knockdown",
    delete_weakest: Annotated[
        int,
        typer.Option(
            min=0, metavar="N", help="also compute each sample without its N weakest defects"
        ),
    ] = 0,
    jobs: Jobs = 1,
    part: Annotated[
        str | None,
        typer.Option(
            metavar="I/N", help="compute only every N-th sample, from the I-th: one of N jobs"
        ),
    ] = None,
    merge: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR", help="take the samples of the jobs' folders, compute none; repeat it"
        ),
    ] = None,
    out: Annotated[str | None, folder_option("results/<case name>_ensemble/")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="refuse a folder without samples of this ensemble")
    ] = False,
) -> None:
    """Run random samples of a case (its section `ensemble`) and fit their statistics; keep finished
    samples.
    """
    from magshell_fenicsx.studies.ensemble.ensemble import ensemble as run_ensemble
    from magshell_fenicsx.studies.runner import local_processes

    with (
        study_folder(out, f"{case.stem}_ensemble") as folder,
        local_processes(jobs) as executor,
    ):
        outcome = run_ensemble(
            case,
            set_ or [],
            samples=samples,
            seed=seed,
            make_case=case_of_source,
            result=result,
            out=folder,
            part=part,
            merge=merge or [],
            delete_weakest=delete_weakest,
            resume=resume,
            executor=executor,
        )
        if (mean := outcome.content["mean"]) is not None:
            found_count = len(outcome.rows) - outcome.without_result
            print_line(f"mean {result} = {mean:.6g} of {found_count} samples")
    if outcome.without_result:
        raise failure(
            f"{outcome.without_result} of {len(outcome.rows)} samples have no {result}; "
            "samples.csv says why",
            STOPPED,
        )


@app.command()
def design(
    case: CaseFile,
    set_: Settings = None,
    out: Annotated[str | None, folder_option("results/<case name>_design/")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="refuse a folder without evaluations of a design")
    ] = False,
) -> None:
    """Vary a case for a result (its section `design`); write the best case, its table and picture,
    and verify it.
    """
    from magshell_fenicsx.studies.design.search import Missed
    from magshell_fenicsx.studies.design.search import design as run_design

    with study_folder(out, f"{case.stem}_design", Missed) as folder:
        run_design(
            case, set_ or [], folder, make_case=shared_case_of_source, resume=resume, say=print_line
        )


@app.command()
def identify(
    case: CaseFile,
    data: Annotated[
        Path, typer.Option(metavar="FILE.csv", help="what was measured: columns with units")
    ],
    set_: Settings = None,
    out: Annotated[str | None, folder_option("results/<case name>_identify/")] = None,
) -> None:
    """Find numbers of a case from measured data (its section `identify`), and how sure they are;
    keep evaluations.
    """
    from magshell_fenicsx.simulate.record import Stopped
    from magshell_fenicsx.studies.identify.identification import identify as identify_parameters

    with study_folder(out, f"{case.stem}_identify", Stopped) as folder:
        outcome = identify_parameters(
            case, data, set_ or [], folder, make_case=shared_case_of_source, say=print_line
        )
    if outcome.fit.ended != "converged":
        raise failure(f"stopped early: {outcome.fit.ended}", STOPPED)


@app.command()
def compare(
    case: CaseFile,
    set_: Settings = None,
    shell: Annotated[
        str,
        typer.Option(metavar="R,R", help="refinements of the shell's mesh; the finest is compared"),
    ] = "1",
    solid: Annotated[
        str,
        typer.Option(
            metavar="R,R", help="refinements of the solid's mesh; three give error against run time"
        ),
    ] = "1",
    result: Annotated[
        str | None, result_option("what is compared; default k_d, or the load: ")
    ] = None,
    out: Annotated[str | None, folder_option("results/<case name>_compare/")] = None,
) -> None:
    """Run a case as a shell and as a solid; compare their curves and run times."""
    from magshell_fenicsx.studies.compare.comparison import compare as run_comparison
    from magshell_fenicsx.studies.compare.comparison import parse_refinements
    from magshell_fenicsx.studies.compare.model_runs import NothingLeft

    with study_folder(out, f"{case.stem}_compare", NothingLeft) as folder:
        refinements = parse_refinements(shell, solid)
        outcome = run_comparison(
            case,
            set_ or [],
            refinements=refinements,
            out=folder,
            make_case=case_of_source,
            result=result,
            say=print_line,
        )
        difference = outcome.content["difference"]
        if difference is not None:
            print_line(
                f"{outcome.content['result']}: the solid differs from the shell by "
                f"{100 * difference:+.3f} %"
            )


app.add_typer(inspection.app)
