"""Examples that are written to a file are the cases of the repository, wherever that file is."""

from pathlib import Path

import pytest
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.examples import examples, title, write_example
from magshell_fenicsx.input.source import CaseError

FILES = [*CASES.glob("*.yaml"), *CASES.glob("benchmarks/*.yaml")]


def test_every_case_has_a_name_and_a_title() -> None:
    """A title stands in one line beside its name, is not that of another, and not cut off in a
    sentence.
    """
    assert sorted(examples().values()) == sorted(FILES)
    titles = [title(file) for file in FILES]
    assert len(set(titles)) == len(titles)
    for words in titles:
        assert 10 < len(words) < 115
        assert words[0].isupper()
        assert words.count("(") == words.count(")")
        assert ". " not in words.replace("et al. ", "")


@pytest.mark.parametrize("name", examples())
def test_a_case_that_is_written(name: str, tmp_path: Path) -> None:
    """Is the same case, with the same mesh, and names nothing that is not there."""
    source, target = examples()[name], tmp_path / "mine.yaml"
    assert write_example(name, target)[0] == target
    here, there = Case.load(target), Case.load(source)
    assert here.outside == there.outside
    assert None not in here.outside.values()
    assert here.model_dump(exclude={"shell": {"file"}}) == there.model_dump(
        exclude={"shell": {"file"}}
    )
    assert "../" not in target.read_text(encoding="utf-8")


def test_where_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Into the folder where one is, or where one says; a mesh stands beside the case, and two cases
    may share it.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deep").mkdir()
    assert write_example("hinged_roof_12.7") == [Path("hinged_roof_12.7.yaml")]
    assert write_example("gripper") == [Path("gripper.yaml"), Path("gripper.msh")]
    assert write_example("gripper", Path("other.yaml")) == [Path("other.yaml"), Path("gripper.msh")]
    assert write_example("identify_arch")[2:] == [Path("arch_snap.yaml"), Path("arch_triangle.csv")]
    write_example("gripper", Path("deep/other.yaml"))
    assert sorted(file.name for file in (tmp_path / "deep").iterdir()) == [
        "gripper.msh",
        "other.yaml",
    ]


def test_nothing_is_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a case nor a mesh of another content; what is refused leaves nothing."""
    monkeypatch.chdir(tmp_path)
    write_example("clamped_plate")
    with pytest.raises(
        CaseError,
        match=r"^clamped_plate\.yaml: is there already, and is kept; name a file elsewhere$",
    ):
        write_example("clamped_plate")
    (tmp_path / "gripper.msh").write_text("of my own", encoding="utf-8")
    with pytest.raises(CaseError, match=r"^gripper\.msh: is there already"):
        write_example("gripper")
    assert not (tmp_path / "gripper.yaml").exists()
    assert (tmp_path / "gripper.msh").read_text(encoding="utf-8") == "of my own"


@pytest.mark.parametrize("name", ["clamped_plate", "gripper"])
@pytest.mark.parametrize(
    "file", [".", "/", "..", "nowhere/case.yaml", "clamped_plate.yaml/case.yaml"]
)
def test_what_cannot_be_written(
    name: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Is one message with the place."""
    monkeypatch.chdir(tmp_path)
    write_example("clamped_plate")
    with pytest.raises(
        CaseError, match=r"^\S+: (is there already|cannot be written: (No such file|Not a dir))"
    ):
        write_example(name, Path(file))


def test_a_name_that_is_none() -> None:
    """The message has those that are."""
    with pytest.raises(
        CaseError, match=r"^example dimple: there is no such case, only arch, .*dimple_buckling, "
    ):
        write_example("dimple")
