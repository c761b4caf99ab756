"""What a scene is built from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.grid import Grid, grid_mesh
from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.patch import Embedding, PatchMesh
from magshell_fenicsx.mesh.shapes import Shape
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Condition, Loads, Material
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.plan.names import refuse_unfit


@dataclass(frozen=True)
class Plan:
    """Everything that a scene is built from, dimensionless (lengths in R).

    Attributes
    ----------
    axisymmetric
        Model the meridian.
    half
        Model the half y >= 0 of a frame turned about e3 by `azimuth` (rad).
    shape, size, points, embedding
        What is triangulated, and how it is put into space. The point "pole" is the one whose
        displacement is reported: the pole, the disc's centre, the strip's tip.
    included, left_out
        What the model has and lacks, for people.
    thickness
        What multiplies the thickness; None for 1.
    length
        R in the unit that results are told in.
    own
        One's own energies; `loads` has them too, after those of the case's parts.
    """

    material: Material
    loads: Loads
    conditions: dict[str, Condition]
    axisymmetric: bool
    half: bool
    azimuth: float
    shape: Shape | Grid | MeshFile
    embedding: Embedding
    points: dict[str, NDArray[np.float64]]
    size: Size
    included: list[str]
    left_out: list[str]
    thickness: Thickness | None = None
    length: float = 1.0
    own: tuple[OwnTerm, ...] = ()

    @property
    def fixed(self) -> bool:
        """Whether something is clamped, so that there is no rigid motion."""
        return "clamped" in self.conditions.values()

    def triangulated(self) -> PatchMesh:
        """The triangulation; call it on one rank only.

        Raises
        ------
        MeshError
            If there is none, it cannot carry a shell, or it has not what the plan names.
        """
        patch = self._made()
        refuse_unfit(patch, self.conditions, self.loads, self.thickness)
        return patch

    def _made(self) -> PatchMesh:
        if isinstance(self.shape, MeshFile):
            return read_msh(self.shape, self.points)
        if isinstance(self.shape, Grid):
            return grid_mesh(self.shape, self.points, self.embedding)
        return triangulate(self.shape, self.size, self.points, self.embedding)
