"""Messages about names of a mesh file, which only the mesh knows, have file and line too."""

from pathlib import Path

import pytest
from command import magshell
from conftest import CASES


@pytest.mark.parametrize(
    ("written", "instead", "message"),
    [
        (
            "      east:",
            "      eest:",
            "magnetic.remanent.patches: eest: the surface has no such patch, only hub, east, ",
        ),
        (
            "hub: clamped",
            "hob: clamped",
            "boundary.hob: the surface has no such edge, only east, hub, ",
        ),
    ],
)
def test_names_of_a_mesh_file_have_a_line(
    tmp_path: Path, written: str, instead: str, message: str
) -> None:
    text = (
        (CASES / "gripper.yaml")
        .read_text(encoding="utf-8")
        .replace("../meshes", str(CASES.parent / "meshes"))
    )
    file = tmp_path / "gripper.yaml"
    file.write_text(text.replace(written, instead), encoding="utf-8")
    line = next(
        i
        for i, each in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        if instead in each
    )
    for command in (("check", file), ("run", file, "--out", tmp_path / "out")):
        done = magshell(*command)
        assert done.returncode == 2
        assert done.stderr.startswith(f"{file}:{line}: {message}")


def test_patches_of_a_setting_are_checked_before_a_run() -> None:
    setting = "natural={curvature: {easst: 1}}"
    done = magshell("check", CASES / "gripper.yaml", "--set", setting)
    assert done.stderr.startswith(
        f"--set {setting}: natural.curvature: easst: the surface has no such patch, only hub"
    )
