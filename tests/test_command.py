"""What the shell offers: of the real program, as the script of `--show-completion bash` asks it."""

from pathlib import Path

import pytest
from command import started as magshell
from conftest import CASES

from magshell_fenicsx.case.examples import examples
from magshell_fenicsx.command import case_files


def offered(monkeypatch: pytest.MonkeyPatch, line: str) -> list[str]:
    """For the last word of a line."""
    monkeypatch.setenv("_MAGSHELL_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    done = magshell()
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.split()


def test_case_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that begin so, a folder deeper too; brackets in a name are no pattern; nothing else."""
    monkeypatch.chdir(tmp_path)
    for name in (
        "one.yaml",
        "other[1].yaml",
        "notes.txt",
        "cases/plate.yaml",
        "cases/deep/far.yaml",
        ".hidden.yaml",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert case_files("o") == ["one.yaml", "other[1].yaml"]
    assert case_files("other[") == ["other[1].yaml"]
    assert case_files("ca") == ["cases/plate.yaml"]
    assert case_files("cases/deep/") == ["cases/deep/far.yaml"]
    assert case_files("./ca") == ["./cases/plate.yaml"]
    assert case_files(f"{tmp_path}/o") == [f"{tmp_path}/one.yaml", f"{tmp_path}/other[1].yaml"]
    assert case_files("none") == []


@pytest.mark.parametrize(
    ("line", "offers"),
    [
        ("magshell ex", ["example"]),
        ("magshell run cases/snap_", ["cases/snap_back.yaml", "cases/snap_map.yaml"]),
        ("magshell example snap_", ["snap_back", "snap_map"]),
        ("magshell plot resu", []),
        ("magshell run cases/snap_back.yaml --out resu", []),
    ],
)
def test_what_is_offered(monkeypatch: pytest.MonkeyPatch, line: str, offers: list[str]) -> None:
    """Nothing where any file or folder will do: the shell then offers its own."""
    monkeypatch.chdir(CASES.parent)
    assert offered(monkeypatch, line) == offers


def test_names_of_examples(monkeypatch: pytest.MonkeyPatch) -> None:
    assert offered(monkeypatch, "magshell example ") == list(examples())


def test_the_script_for_a_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asks for what is tested above, and the options that install it are there."""
    assert "--install-completion" in magshell("--help").stdout
    assert "None" not in magshell("run", "--help").stdout
    monkeypatch.setenv("_MAGSHELL_COMPLETE", "source_bash")
    script = magshell().stdout
    assert "_MAGSHELL_COMPLETE=complete_bash" in script
    assert "complete -o default" in script
