"""What a solid refuses, what is planned for it, and its modes."""

from pathlib import Path

import numpy as np
import pytest
import pyvista
from conftest import CASES

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.vtu import unstructured_grid
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.shells.solid import SolidModel

BUCKLING, INDENTATION = CASES / "solid_buckling.yaml", CASES / "solid_indentation.yaml"


@pytest.mark.parametrize(
    ("file", "setting", "said"),
    [
        (BUCKLING, "model=shel", "model: 'shel'"),
        (
            BUCKLING,
            "magnetic.energy=torque",
            "magnetic.energy: torque: needs a mid-surface; or give energy: full",
        ),
        (BUCKLING, "mesh.degree=4", "mesh.degree: not of a solid"),
        (BUCKLING, "mesh.degree=4", "mesh.refinement makes it finer"),
        (
            CASES / "bracket.yaml",
            "model=solid",
            "mesh.degree: not of a solid, which has degree 2; a file with smaller",
        ),
        (BUCKLING, "mesh.penalty=4", "mesh.penalty: not of a solid"),
        (BUCKLING, "symmetry=axisymmetric", "a solid is whole or half"),
        (BUCKLING, "solid={layers: 0}", "solid.layers: 0: must be greater than or equal to 1"),
        (INDENTATION, "loading.patch=0", "a point force sinks into a solid without limit"),
    ],
)
def test_what_a_solid_cannot_is_refused(file: Path, setting: str, said: str) -> None:
    with pytest.raises(CaseError) as error:
        Case.load(file, [setting])
    assert said in str(error.value)


def test_what_belongs_to_a_solid_is_refused_for_a_shell() -> None:
    with pytest.raises(CaseError, match="solid belongs to model: solid"):
        Case.load(BUCKLING, ["model=shell", "solid={layers: 2}"])
    with pytest.raises(CaseError, match=r"place of shell\.poisson_ratio: 0\.5"):
        Case.load(BUCKLING, ["shell.poisson_ratio=0.4", "solid={bulk_to_shear: 50}"])


def test_check_tells_the_mesh_that_is_built() -> None:
    """Cells and unknowns of `magshell check` are those of the scene; two layers."""
    case = Case.load(
        BUCKLING, ["mesh.refinement=0.2", "shell.radius_to_thickness=20", "solid={layers: 2}"]
    )
    scene = Scene(case)
    assert make_problem(case).is_half
    assert f"mesh: {scene.cells} cells of degree 2, {scene.model.system.dofs} unknowns" in describe(
        case
    )
    assert "kappa/mu = 100 (E = 0.99668, nu = 0.49502 for small strains), 2 layers" in describe(
        case
    )


def test_paraview_sees_the_whole_body() -> None:
    """The hexahedra of the fields fill half a spherical shell: 2 pi h (1 + h^2/12)/2, without a
    dimple.

    VTK cuts the curved cells into flat pieces.
    """
    settings = [
        "shell.radius_to_thickness=20",
        "shell.defect=null",
        "mesh.refinement=1",
        "symmetry=half",
    ]
    scene = Scene(Case.load(BUCKLING, settings))
    surface = gatherer(scene.model, scene.comm).gather(scene.model.zero())
    assert surface is not None
    assert (
        np.linalg.norm(surface.r0 - surface.n0 * np.sum(surface.r0 * surface.n0, axis=1)[:, None])
        < 1e-8
    )
    sizes = pyvista.wrap(unstructured_grid(surface, 0.05, deformed=True)).compute_cell_sizes(
        length=False, area=False
    )["Volume"]
    assert sizes.min() > 0
    assert sizes.sum() == pytest.approx(np.pi * 0.05 * (1 + 0.05**2 / 12), rel=5e-3)


def test_half_solid_knows_its_antisymmetric_modes() -> None:
    """Around the axis every wave has a twin turned by a quarter of its length: one in each family
    of a half.

    The lowest of them all, at rest, is the same in both, up to the mesh; lower ones would be
    axisymmetric.
    """
    settings = [
        "shell.radius_to_thickness=20",
        "shell.defect=null",
        "mesh.refinement=0.5",
        "symmetry=half",
    ]
    scene = Scene(Case.load(BUCKLING, settings))
    assert isinstance(scene.model, SolidModel)
    modes = ShellModes(scene.model).lowest(scene.unloaded(), 2)
    lowest = {
        label: min(m.eigenvalue for m in modes if m.label == label)
        for label in ("", "antisymmetric")
    }
    assert lowest["antisymmetric"] == pytest.approx(lowest[""], rel=1e-2)
