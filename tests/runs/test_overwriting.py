"""A run replaces what is in its folder only if that belongs to the same case file."""

import json
from pathlib import Path

import pytest
from command import magshell
from conftest import CASES

import magshell_fenicsx as ms
from magshell_fenicsx.output.store.run_identity import empty_checkpoint

FILE = CASES / "dimple_buckling.yaml"
SMALL = ("--set", "mesh.refinement=0.3", "--set", "mesh.degree=2", "--no-pictures")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    assert magshell("run", FILE, *SMALL, "--out", tmp_path / "out").returncode == 0
    return tmp_path / "out"


def other(folder: Path, text: str = "") -> Path:
    """A case file of another name."""
    (folder / "other.yaml").write_text(FILE.read_text(encoding="utf-8") + text, encoding="utf-8")
    return folder / "other.yaml"


def test_another_case_is_refused(out: Path, tmp_path: Path) -> None:
    before = (out / "summary.json").read_bytes()
    case = other(tmp_path, "symmetry: half\n")
    refused = magshell("run", case, *SMALL, "--out", out)
    assert refused.returncode == 2
    said = (
        f"--out {out}: has a run of dimple_buckling.yaml, which is kept; give another folder, "
        "or --overwrite"
    )
    assert said in " ".join(refused.stderr.split())
    assert (out / "summary.json").read_bytes() == before
    with pytest.raises(ms.CaseError, match="which is kept; give another folder"):
        ms.run(case, out)
    assert magshell("run", case, *SMALL, "--out", out, "--overwrite").returncode == 0
    assert (
        json.loads((out / "summary.json").read_text(encoding="utf-8"))["case_file"] == "other.yaml"
    )


def test_the_same_file_with_other_values(out: Path) -> None:
    assert (
        magshell("run", FILE, *SMALL, "--set", "magnetic.lambda_m=0.001", "--out", out).returncode
        == 0
    )


def test_the_same_case_in_another_file(out: Path, tmp_path: Path) -> None:
    assert magshell("run", other(tmp_path), *SMALL, "--out", out).returncode == 0


def test_an_interrupted_run_of_another_file_is_kept_too(tmp_path: Path) -> None:
    (tmp_path / "checkpoint").write_bytes(empty_checkpoint(ms.Case.load(FILE).problem().document))
    with pytest.raises(ms.CaseError, match=r"has a run of dimple_buckling\.yaml"):
        ms.run(other(tmp_path, "symmetry: half\n"), tmp_path)
    assert (tmp_path / "checkpoint").exists()


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


REFUSED = {
    "scene": 'shell.thickness_factor="1/0"',
    "gradients": "gradients={of: [nope], by: [lambda_m]}",
}


@pytest.mark.parametrize(
    ("what", "how", "ranks"), [("scene", "", 0), ("gradients", "--overwrite", 0), ("scene", "", 2)]
)
def test_what_is_refused_loses_nothing(out: Path, what: str, how: str, ranks: int) -> None:
    """Also if it is refused only when its scene is built."""
    before = content(out)
    refused = magshell(
        "run",
        FILE,
        *SMALL,
        "--set",
        REFUSED[what],
        "--out",
        out,
        *([how] if how else []),
        ranks=ranks,
    )
    assert refused.returncode == 2
    assert content(out) == before


def test_what_is_refused_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ms.CaseError, match="nope"):
        ms.run(ms.Case.load(FILE, ["gradients={of: [nope], by: [lambda_m]}"]), tmp_path / "new")
    assert not (tmp_path / "new").exists()


MINE = (
    "path.csv",
    "summary.json",
    "mesh.json",
    "report.html",
    "shell.png",
    "fields/point_0000.vtu",
)


@pytest.mark.parametrize("text", ["", "[]", '{"case": {}}', "mine"])
def test_files_of_others_are_refused(tmp_path: Path, text: str) -> None:
    """A folder without a run, with names that a run would write."""
    (tmp_path / "fields").mkdir()
    for name in (*MINE, "notes.txt", "fields/mine.csv"):
        (tmp_path / name).write_text(text, encoding="utf-8")
    before = content(tmp_path)
    for how in ([], ["--overwrite"], ["--resume"]):
        refused = magshell("run", FILE, *SMALL, "--out", tmp_path, *how)
        assert refused.returncode == 2
        assert refused.stderr == (
            f"{tmp_path}: has files that a run would replace and that none is known to "
            "have written: "
            f"{', '.join(sorted(MINE))}; move them away, or give another folder\n"
        )
        assert content(tmp_path) == before


def test_files_of_others_stay(out: Path) -> None:
    """Under names that no run writes they survive, also beside its own; under such a name they are
    refused.
    """
    mine = ("notes.txt", "shell_1.png", "fields/mine.csv", "fields/point_mine.vtu")
    for name in mine:
        (out / name).write_text("mine", encoding="utf-8")
    (out / "animation.gif").write_text("mine", encoding="utf-8")
    refused = magshell("run", FILE, *SMALL, "--out", out)
    assert refused.returncode == 2
    assert "none is known to have written: animation.gif; move" in refused.stderr
    assert "animation.gif" in magshell("plot", out).stderr
    (out / "animation.gif").rename(out / "mine.gif")
    for how in ([], ["--overwrite"]):
        assert magshell("run", FILE, *SMALL, "--out", out, *how).returncode == 0
    assert {name for name, text in content(out).items() if text == b"mine"} == {*mine, "mine.gif"}


def test_results_of_earlier_versions(out: Path) -> None:
    """They have no list of what is theirs: their summary.json says that all is."""
    (out / "written.txt").unlink()
    assert magshell("plot", out, "--point", 1).returncode == 0
    assert "fields/path.pvd\n" in (out / "written.txt").read_text(encoding="utf-8")
    assert "shell_0001.png\n" in (out / "written.txt").read_text(encoding="utf-8")
    assert magshell("run", FILE, *SMALL, "--out", out).returncode == 0
    assert not (out / "shell_0001.png").exists()


def test_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`--out "$NOT_SET"` does not mean the working folder."""
    monkeypatch.chdir(tmp_path)
    for command in (["run", FILE], ["sweep", FILE, "--over", "mesh.degree=2,3"], ["design", FILE]):
        refused = magshell(*command, "--out", "")
        assert (refused.returncode, list(tmp_path.iterdir())) == (2, [])
        assert refused.stderr.startswith("--out: is empty; give the name of a folder")
    with pytest.raises(ms.CaseError, match="--out: is empty"):
        ms.run(FILE, "")


@pytest.mark.parametrize("name", ["n" * 300, "\udcff", "a\0b"])
def test_no_possible_name(tmp_path: Path, name: str) -> None:
    """Said before anything is solved: a report in UTF-8 could not name the folder."""
    refused = magshell("run", FILE, *SMALL, "--out", f"{tmp_path}/{name}")
    assert (refused.returncode, refused.stderr.count("\n"), refused.stdout) == (2, 1, "")
    assert refused.stderr.startswith("--out ")
    assert not list(tmp_path.iterdir())
