"""A run replaces what is in its folder only if that belongs to the same case file."""

import json
from pathlib import Path

import pytest
from command import magshell
from conftest import CASES

import magshell_fenicsx as ms
from magshell_fenicsx.output.store import checkpoint

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
    said = f"--out {out}: has a run of dimple_buckling.yaml, which is kept; give another folder, or --overwrite"
    assert said in " ".join(refused.stderr.split())
    assert (out / "summary.json").read_bytes() == before
    with pytest.raises(ms.CaseError, match="which is kept; give another folder"):
        ms.run(case, out)
    assert magshell("run", case, *SMALL, "--out", out, "--overwrite").returncode == 0
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["case_file"] == "other.yaml"


def test_the_same_file_with_other_values(out: Path) -> None:
    assert magshell("run", FILE, *SMALL, "--set", "magnetic.lambda_m=0.001", "--out", out).returncode == 0


def test_the_same_case_in_another_file(out: Path, tmp_path: Path) -> None:
    assert magshell("run", other(tmp_path), *SMALL, "--out", out).returncode == 0


def test_an_interrupted_run_is_kept_too(tmp_path: Path) -> None:
    checkpoint.begin_checkpoint(tmp_path / "checkpoint", ms.Case.load(FILE))
    with pytest.raises(ms.CaseError, match=r"has a run of dimple_buckling\.yaml"):
        ms.run(other(tmp_path, "symmetry: half\n"), tmp_path)
    assert (tmp_path / "checkpoint").exists()


@pytest.mark.parametrize("content", ["", "[]", '{"case": {}}'])
def test_a_folder_of_nobody_known(tmp_path: Path, content: str) -> None:
    """Without a name, as in results of earlier versions."""
    (tmp_path / "summary.json").write_text(content, encoding="utf-8")
    assert magshell("run", FILE, *SMALL, "--out", tmp_path).returncode == 0
