"""What a scene is built from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.grid import Grid, grid_mesh
from magshell_fenicsx.mesh.mirror import Mirror, cut
from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.patch import Embedding, PatchMesh
from magshell_fenicsx.mesh.shapes import Shape
from magshell_fenicsx.mesh.triangulation import triangulate
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
    mirror
        Plane of the half that is modelled; None for all.
    azimuth
        The model's frame is turned about e3 by it (rad).
    shape, size, points, embedding
        What is triangulated, and how it is put into space. The point "pole" is the one whose
        displacement is reported: the pole, the disc's centre, the strip's tip.
    included, left_out
        What the model has and lacks, for people.
    thickness
        What multiplies the thickness; None for 1.
    length
        R in the unit that results are told in.
    """

    material: Material
    loads: Loads
    conditions: dict[str, Condition]
    axisymmetric: bool
    mirror: Mirror | None
    azimuth: float
    shape: Shape | Grid | MeshFile
    embedding: Embedding
    points: dict[str, NDArray[np.float64]]
    size: Size
    included: list[str]
    left_out: list[str]
    thickness: Thickness | None = None
    length: float = 1.0

    @property
    def half(self) -> bool:
        return self.mirror is not None

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
            return read_msh(self.shape, self.points, self.mirror)
        if isinstance(self.shape, Grid):
            patch = grid_mesh(self.shape, self.points, self.embedding)
            return cut(patch, self.mirror) if self.mirror else patch
        return triangulate(self.shape, self.size, self.points, self.embedding)
