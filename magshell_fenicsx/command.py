"""Common parts of all commands: options, completion in the shell, messages, exit codes.

Typer is imported without rich where no help is asked for: the import of rich takes 0.15 s of every
command. A rank is a process of MPI; rank 0 prints. The shell is here that of the command line.
"""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from glob import escape, glob
from pathlib import Path
from typing import Annotated, Any, TypeVar

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.platform import terminal
from magshell_fenicsx.platform.disk_cache import UnsafeCache
from magshell_fenicsx.platform.packages import Unusable
from magshell_fenicsx.platform.processes import world

_without_rich = "rich" not in sys.modules and "--help" not in sys.argv and len(sys.argv) > 1
if _without_rich:
    # an import of it fails, as where it is not installed
    sys.modules["rich"] = None  # type: ignore[assignment]
try:
    import typer as typer
finally:
    if _without_rich:
        del sys.modules["rich"]

INVALID, STOPPED = 2, 3  # exit codes, beside `INTERRUPTED`
FAILURE_TAG = 32101  # tag of the messages between ranks that fail
MAX_DELAY_OF_ERRORS = 5.0  # s in which an error of all ranks reaches the last of them
DELIVERY_TIME = 0.2  # s in which a message is on its way to the terminal
UNWRITTEN = "kernels cannot be compiled into"

Function = TypeVar("Function", bound=Callable[..., Any])


class Command(typer.core.TyperCommand):
    """A command whose help does not call None the default of what may be left out."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for param in self.params:
            param.show_default = param.default is not None and param.show_default  # type: ignore[attr-defined]


class Commands(typer.Typer):
    """Commands of a program, each a `Command`."""

    def command(self, *args: Any, **kwargs: Any) -> Callable[[Function], Function]:
        return super().command(*args, cls=Command, **kwargs)


def case_files(incomplete: str) -> list[str]:
    """Return case files with this beginning, here or one folder deeper.

    If there are none, the shell of the command line completes file names itself.
    """
    begin = escape(incomplete)
    files = glob(f"{begin}*.yaml") + glob(f"{begin}*/*.yaml")  # noqa: PTH207 - a Path would lose the ./ that was typed
    return sorted(files)


def left_to_the_shell() -> list[str]:
    """Return no completions, so that the shell completes names of files.

    By default the shell would only add a blank.
    """
    return []


CaseFile = Annotated[
    Path, typer.Argument(metavar="CASE.yaml", help="the case file", autocompletion=case_files)
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY.PATH=VALUE", help="replace a key of the case"),
]
Jobs = Annotated[
    int,
    typer.Option(
        min=1, max=1024, metavar="N", help="compute N at a time, in processes of this machine"
    ),
]
Over = Annotated[
    list[str],
    typer.Option(
        metavar="KEY.PATH=START:STOP:COUNT",
        help="or =VALUE,VALUE; repeat for a product, tie keys with +",
    ),
]


def result_option(begin: str = "") -> Any:
    """Return the option that names a result; its help starts with `begin`."""
    return typer.Option(
        "--result",
        metavar="NAME",
        help=f"{begin}knockdown, critical_field, force@w_over_h=10, energy@end, ...",
    )


Result = Annotated[str, result_option()]
Run = Annotated[
    Path,
    typer.Argument(
        metavar="DIR",
        help="folder of a finished or interrupted run",
        autocompletion=left_to_the_shell,
    ),
]


Runs = Annotated[
    list[Path],
    typer.Argument(
        metavar="DIR...",
        help="folders of finished or interrupted runs",
        autocompletion=left_to_the_shell,
    ),
]


def points_of(text: str | None) -> list[int]:
    """Return the numbers of points in `--shapes`, such as "0,12,40"; none without the option.

    Raises
    ------
    CaseError
        If they cannot be read.
    """
    try:
        return [int(number) for number in text.split(",")] if text else []
    except ValueError:
        raise CaseError(
            f"--shapes {text}: write it as numbers of points, for example 0,12,40"
        ) from None


def folder_option(default: str) -> Any:
    """Return the option that names the output folder."""
    return typer.Option(help=f"output folder; default {default}", autocompletion=left_to_the_shell)


def chosen_folder(out: str | None, default: str) -> Path:
    """Return the folder that an option names, or the default folder in results/.

    The command ends if the option is no usable folder.
    """
    from magshell_fenicsx.output.store.folder import user_folder

    with exit_codes():
        return Path("results") / default if out is None else user_folder(out)


@contextmanager
def study_folder(out: str | None, default: str, *stopped: type[Exception]) -> Iterator[Path]:
    """Context of a study with its folder, which is printed at the end; the command gets exit codes.

    Parameters
    ----------
    out, default
        The folder that an option names, and its default in results/.
    stopped
        Exceptions of an early stop, beside that of a full disk.
    """
    from magshell_fenicsx.output.store.folder import DiskError

    folder = chosen_folder(out, default)
    with exit_codes(stopped=(DiskError, *stopped)):
        yield folder
        print_line(f"results in {folder}/")


def picture_options(
    formats: str | None,
    width: float | None,
    dpi: int | None,
    font_size: float | None,
    camera: str | None,
    ranges: Sequence[str],
) -> dict[str, Any]:
    """Return the options of pictures as keys of the section `output`; options of None are left out.

    Parameters
    ----------
    formats
        Kinds of files, such as "svg,pdf".
    width, dpi, font_size
        Width of a picture in mm, pixels per inch, and size of text in points.
    camera
        "POLAR,AZIMUTH" in degrees.
    ranges
        Texts "FIELD=LOW:HIGH".

    Raises
    ------
    CaseError
        If a camera or a range cannot be read.
    """
    # what is not given is None, and left out at the end: there the case's own options stay
    keys: dict[str, Any] = {"width": width, "dpi": dpi, "font_size": font_size}
    keys["formats"] = formats.split(",") if formats else None
    if camera:
        angles = _numbers(
            camera,
            ",",
            f"--camera {camera}: write it as POLAR,AZIMUTH in degrees, for example 55,-60",
        )
        keys["camera"] = dict(zip(("polar", "azimuth"), angles, strict=True))
    if ranges:
        keys["ranges"] = {}
    for text in ranges:
        name, _, limits = text.partition("=")
        message = f"--range {text}: write it as FIELD=LOW:HIGH, for example w_over_h=-2:2"
        keys["ranges"][name] = list(_numbers(limits, ":", message))
    return {key: value for key, value in keys.items() if value is not None}


def _numbers(text: str, separator: str, message: str) -> tuple[float, float]:
    """Return the two numbers of a text, joined by a separator.

    Raises
    ------
    CaseError
        With `message`, if the text has not two numbers.
    """
    try:
        first, second = map(float, text.split(separator))
    except ValueError:
        raise CaseError(message) from None
    return first, second


def print_line(line: str) -> None:
    """Print a line on rank 0."""
    if world().rank == 0:
        terminal.print_line(line)


def failure(message: str, code: int) -> typer.Exit:
    """Print the message of an error once, and return the exception that ends this rank.

    The caller raises it. If the other ranks have no error, all ranks are aborted at once.

    Parameters
    ----------
    code
        Exit code: `INVALID` or `STOPPED`.
    """
    comm = world()
    if comm.size > 1 and not _all_fail(comm):
        print(f"rank {comm.rank}: {message}", file=sys.stderr, flush=True)
        time.sleep(DELIVERY_TIME)
        comm.Abort(code)  # the other ranks would wait for this one for ever
    if comm.rank:
        # mpirun ends the job at the first failing rank, and may lose the message of rank 0
        return typer.Exit()  # with code 0
    with suppress(OSError):  # a full disk: the exit code says it
        print(message, file=sys.stderr, flush=True)
    return typer.Exit(code)


def _all_fail(comm: Any) -> bool:
    """Return whether all ranks come here within a delay, as they do with an error of all ranks.

    Parameters
    ----------
    comm
        Communicator of all ranks; each sends a message to every other rank.
    """
    from mpi4py import MPI

    other_ranks = [rank for rank in range(comm.size) if rank != comm.rank]
    deadline = time.monotonic() + MAX_DELAY_OF_ERRORS
    for rank in other_ranks:  # a message of one byte says that this rank fails
        comm.Isend(bytearray(1), rank, FAILURE_TAG)
    # single messages, no collective call: the other ranks may wait in another collective call
    requests = [comm.Irecv(bytearray(1), rank, FAILURE_TAG) for rank in other_ranks]
    while not MPI.Request.Testall(requests):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def refuse_lost() -> None:
    """End a command whose only result is printed text, if this text was not written."""
    if terminal.output_failures:
        raise failure(f"stopped early: {terminal.output_failures[0]}", STOPPED)


@contextmanager
def exit_codes(stopped: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Turn an invalid input or an early stop into a message and the exit code of the command.

    A kernel that cannot be written counts as an early stop too.

    Parameters
    ----------
    stopped
        Exceptions of an early stop.
    """
    try:
        yield
    except (CaseError, MeshError, UnsafeCache, Unusable) as e:
        raise failure(str(e), INVALID) from None
    except stopped as e:
        raise failure(f"stopped early: {e}", STOPPED) from None
    except RuntimeError as e:
        if str(e).startswith(UNWRITTEN):
            raise failure(f"stopped early: {e}", STOPPED) from None
        raise
