"""Results that were cut off or changed: one message with the file's name, and no traceback."""

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from command import magshell, read_path
from conftest import CASES, draw_nothing
from interrupted import check_same_path

from magshell_fenicsx.output.store.journal_file import framed
from magshell_fenicsx.runs.running import Watch

CASE = (CASES / "dimple_buckling.yaml", "--set=mesh={refinement: 0.3, degree: 2}")
Damage = Callable[[bytes], bytes]


def cut(content: bytes) -> bytes:
    return content[: len(content) * 9 // 10]


def one_of(content: bytes) -> Damage:
    """A damage that leaves nothing of the file."""
    return lambda _: content


def swapped(old: bytes, new: bytes) -> Damage:
    def swap(content: bytes) -> bytes:
        assert old in content
        return content.replace(old, new, 1)

    return swap


def in_first_row(column: str, text: str) -> Damage:
    def put(content: bytes) -> bytes:
        head, row, *rest = (line.split(",") for line in content.decode().split("\r\n"))
        row[head.index(column)] = text
        return "\r\n".join(",".join(line) for line in (head, row, *rest)).encode()

    return put


BINARY = one_of(bytes(range(256)))
LONGEST = swapped(b"MSF1", b"MSF1" + (2**62).to_bytes(8, "little"))
PATH = {
    "binary": BINARY,
    "no table": one_of(b"a\nb\n"),
    **{
        text[:4]: swapped(b"step,pressure,0.", f"step,pressure,{text}".encode())
        for text in ("1e308", 5000 * "1")
    },
    **{text: in_first_row("w_over_h", text) for text in ("nan", "inf")},
    "word": swapped(b"step,pressure,0.", b"step,pressure,abc"),
    "no such load": swapped(b"step,pressure,", b"step,pressurf,"),
    "a count": swapped(b"\r\n1,step", b"\r\n1.5,step"),
    "a short row": swapped(b"\r\n2,step", b"\r\n2\r\n2,step"),
}
JSON = {
    name: one_of(name.encode()) for name in ("{", "[]", "{}", '{"a": 1}', "3", '{"case": 3}')
} | {"binary": BINARY}
FIELDS = {"cut": cut, "binary": BINARY, "another array": swapped(b'"r0"', b'"r1"')}
HEADS = {name: one_of(framed(name.encode())) for name in ("[1]", "3", "{")} | {
    "long": LONGEST,
    "binary": BINARY,
}
OF_COMPLETE = [
    *(("path.csv", name, damage) for name, damage in PATH.items()),
    *(("summary.json", name, damage) for name, damage in JSON.items()),
    *(
        ("summary.json", f"no {key}", swapped(f'"{key}"'.encode(), b'"other"'))
        for key in ("stopped", "jit_s", "dofs")
    ),
    *(("fields/point_0004.vtu", name, damage) for name, damage in FIELDS.items()),
]
OF_INTERRUPTED = [
    *(("path.csv", name, damage) for name, damage in PATH.items()),
    *(("checkpoint", name, damage) for name, damage in HEADS.items()),
]


def named(damages: list[tuple[str, str, Damage]]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize(
        ("name", "damage"),
        [(f, d) for f, _, d in damages],
        ids=[f"{f}: {how}" for f, how, _ in damages],
    )


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of five points."""
    out = tmp_path_factory.mktemp("complete") / "out"
    with pytest.MonkeyPatch.context() as patched:
        draw_nothing(patched)
        assert magshell("run", *CASE, "--out", out).returncode == 0
    return out


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run, stopped after four points."""
    out, checks = tmp_path_factory.mktemp("interrupted") / "out", list[None]()

    def check(watch: Watch) -> None:
        checks.append(None)
        if len(checks) > 5:
            watch._limit = 0.0
        own(watch)

    own = Watch.check
    with pytest.MonkeyPatch.context() as patched:
        draw_nothing(patched)
        patched.setattr(Watch, "check", check)
        assert magshell("run", *CASE, "--out", out).returncode == 3
    assert len(read_path(out)) == 4
    return out


def damaged(of: Path, to: Path, name: str, damage: Damage) -> Path:
    """A copy of a folder with one damaged file."""
    shutil.copytree(of, to)
    (to / name).write_bytes(damage((to / name).read_bytes()))
    return to / name


@named(OF_COMPLETE)
def test_of_a_complete_run(complete: Path, tmp_path: Path, name: str, damage: Damage) -> None:
    file = damaged(complete, tmp_path / "out", name, damage)
    (tmp_path / "out/report.html").unlink()
    commands = [("plot", tmp_path / "out"), ("run", *CASE, "--out", tmp_path / "out", "--resume")]
    commands += [("view", tmp_path / "out")] if not name.startswith("fields/") else []
    for command in commands[: 1 if name.startswith("fields/") and damage is not cut else None]:
        done = magshell(*command)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), command
        assert done.stderr.startswith(f"{file}: is damaged"), command


@named(OF_INTERRUPTED)
def test_of_an_interrupted_run(
    interrupted: Path, tmp_path: Path, name: str, damage: Damage
) -> None:
    """Nothing is changed by the refusal."""
    file = damaged(interrupted, tmp_path / "out", name, damage)
    before = file.read_bytes()
    done = magshell("run", *CASE, "--out", tmp_path / "out", "--resume")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith(f"{file}: is damaged")
    assert file.read_bytes() == before


def test_a_field_that_is_cut_off_is_written_again(
    interrupted: Path, complete: Path, tmp_path: Path, no_pictures: None
) -> None:
    out = tmp_path / "out"
    file = damaged(interrupted, out, "fields/point_0002.vtu", cut)
    left = [out / f"fields/point_0003.vtu{ending}" for ending in (".0a1b2c3d.unfinished", ".mine")]
    for each in left:  # of a kill, and of somebody else
        each.write_bytes(b"<VTK")
    assert magshell("run", *CASE, "--out", out, "--resume").returncode == 0
    assert [each.exists() for each in left] == [False, True]
    check_same_path(out, complete)
    assert file.read_bytes() == (complete / "fields/point_0002.vtu").read_bytes()


def test_an_interrupted_run_is_not_erased(
    interrupted: Path, tmp_path: Path, no_pictures: None
) -> None:
    """It says what is there: points, when, why; `--overwrite` starts again.

    A killed run has no summary.
    """
    out = tmp_path / "out"
    shutil.copytree(interrupted, out)
    for how in ("interrupted by the time limit of 0 s", "killed, or its machine stopped"):
        refused = magshell("run", *CASE, "--out", out)
        assert refused.returncode == 2
        assert refused.stderr.startswith(
            f"--out {out}: has a run that was not finished: 4 points, the last on 20"
        )
        assert refused.stderr.endswith(
            f"; {how}. Give --resume to continue it, or --overwrite to start again\n"
        )
        assert len(read_path(out)) == 4
        for file in ("summary.json", "report.html", "written.txt"):
            (out / file).unlink(missing_ok=True)
    assert magshell("run", *CASE, "--out", out, "--overwrite").returncode == 0
    assert len(read_path(out)) == 5
    assert magshell("run", *CASE, "--out", out).returncode == 0  # a complete run may be repeated


SPECIAL: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda file: file.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize(
    "name", ["path.csv", "summary.json", "checkpoint", "written.txt", "fields/point_0001.vtu"]
)
def test_no_regular_file(complete: Path, tmp_path: Path, name: str, kind: str) -> None:
    """It is named, neither waited for nor read without end, and no file beside it is lost."""
    out = tmp_path / "out"
    shutil.copytree(complete, out)
    (out / name).unlink(missing_ok=True)
    SPECIAL[kind](out / name)
    before = sorted(out.rglob("*"))
    run = ("run", *CASE, "--out", out)
    for command in (run, (*run, "--resume"), (*run, "--overwrite"), ("plot", out)):
        refused = magshell(*command)
        assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), command
        assert name in refused.stderr, command
        assert sorted(out.rglob("*")) == before, command


def test_linked_fields(complete: Path, tmp_path: Path) -> None:
    """What is in another folder is neither removed nor written."""
    out = tmp_path / "out"
    shutil.copytree(complete, out)
    (out / "fields").rename(tmp_path / "elsewhere")
    (out / "fields").symlink_to(tmp_path / "elsewhere")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    for how in ((), ("--overwrite",), ("--resume",)):
        refused = magshell("run", *CASE, "--out", out, *how)
        assert (
            refused.returncode,
            "known to have written: fields (a link); move" in refused.stderr,
        ) == (2, True)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize("of", ["complete", "interrupted"])
@pytest.mark.parametrize("removed", [0, 1, 4, 7])
def test_killed_while_making_room(
    of: str, removed: int, tmp_path: Path, request: pytest.FixtureRequest, no_pictures: None
) -> None:
    """What is left of the earlier run is never said to be complete, and the new run can be started
    again.
    """
    out, unlink, done = tmp_path / "out", Path.unlink, list[Path]()
    shutil.copytree(request.getfixturevalue(of), out)

    def killed(file: Path, missing_ok: bool = False) -> None:
        if file.parent in (out, out / "fields") and file.suffix != ".unfinished":
            done.append(file)
            if len(done) > removed:
                raise KeyboardInterrupt
        unlink(file, missing_ok)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Path, "unlink", killed)
        with suppress(KeyboardInterrupt):
            magshell("run", *CASE, "--out", out, "--overwrite")
    assert len(done) == removed + 1
    (out / "checkpoint.new.unfinished").write_bytes(b"MSF1")  # of one more start, killed earlier
    resumed = magshell("run", *CASE, "--out", out, "--resume")
    assert resumed.returncode == 2
    assert resumed.stderr.startswith(
        f"--resume: {out}: a new run was interrupted while it removed the files"
    )
    assert magshell("run", *CASE, "--out", out).returncode == 0
    assert not list(out.glob("checkpoint*"))
    assert len(read_path(out)) == 5
