"""The axisymmetric shell as a system of terms on its meridian.

Lengths in R, energies in E h R^2, of the whole shell. Amplitudes as in `ShellModel`:
"pressure" is p/p_c, "force" is F R/(2 pi D), "lambda_m" is lambda_m.
"""

from functools import cached_property

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.problem import FiniteElementSystem
from magshell_fenicsx.assembly.terms import FormTerm, LinearTerm, Term
from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.models.axisymmetric import jets
from magshell_fenicsx.models.axisymmetric.energies import INTERIOR, Energy, EnergyFactory
from magshell_fenicsx.models.axisymmetric.instability import ExcludedWaves
from magshell_fenicsx.models.axisymmetric.meridian import Meridian, held_at
from magshell_fenicsx.models.axisymmetric.waves import Waves
from magshell_fenicsx.models.shell.load_vector import Entries
from magshell_fenicsx.models.shell.parameters import Condition, Force, Loads, Material, default_penalty

Array = NDArray[np.float64]


class MeridianModel:
    """A Koiter shell of revolution with axisymmetric loads; every rank holds all of it.

    Parameters
    ----------
    degree
        Of displacement and placement, 2 to 5.
    condition
        Of the outer edge.
    loads
        A force at the pole; an applied field along e3, its gradient diag(a, a, b), a remanence
        that is the same along every meridian and has no component across it.
    sigma
        Penalty of the C0 interior penalty form; None takes `default_penalty`.

    Attributes
    ----------
    system
        What the solvers see; u = (U, W) along e_rho and e_z.
    energies
        The terms, as functions of the displacement's jet; without the dead force.
    multiplicity
        1: integrals and forces are those of the whole shell.
    kernels
        Names and compile time of the forms in use.
    """

    multiplicity = 1

    def __init__(
        self,
        meridian: Meridian,
        material: Material,
        degree: int,
        condition: Condition,
        loads: Loads,
        sigma: float | None = None,
    ) -> None:
        self.meridian, self.material, self.degree, self.loads = meridian, material, degree, loads
        self.condition = condition
        self.kernels = KernelLog()
        self.V = V = fem.functionspace(meridian.mesh, ("Lagrange", degree, (2,)))
        self.r0, self.u = meridian.placement(V), fem.Function(V, name="u")
        self.sigma = default_penalty(degree) if sigma is None else sigma
        factory = EnergyFactory(meridian, self.r0, material, self.sigma, degree)
        self.energies = [factory.membrane(), factory.bending(), factory.interior_edges()]
        if condition == "clamped":
            self.energies.append(factory.clamped_edges())
        if loads.magnetic:
            self.energies += factory.magnetic(loads.magnetic)
        if loads.pressure:
            self.energies.append(factory.pressure())
        self.energies += [factory.own(term) for term in loads.own]
        forms = {e.name: self._term(e) for e in self.energies}
        terms: list[Term] = list(forms.values())
        axis = fem.locate_dofs_topological(V, 0, meridian.axis)
        self._pole = np.array([2 * axis[0] + 1], dtype=np.int32)
        if loads.force:
            terms.append(self._force(loads.force, factory))
        held = [held_at(V, meridian.axis, 0)]
        if condition != "free":
            held += [held_at(V, meridian.rim, i) for i in range(2)]
        self.system = FiniteElementSystem(self.u, terms, held, forms[INTERIOR], material.h)
        volume = 2 * np.pi * factory.volume_change(jets.revolved(self.u))
        self._volume = self.kernels.compile("volume energy", volume)

    @cached_property
    def excluded_modes(self) -> ExcludedWaves:
        """The waves around the axis, which an axisymmetric model does not see. Compiles kernels."""
        return ExcludedWaves(Waves(self.system, self.energies, self.meridian, self.condition, self.kernels))

    def zero(self) -> Vector:
        """The undeformed displacement."""
        return np.zeros(self.system.size)

    def volume_change(self, u: Vector) -> float:
        """Delta V/R^3 of the whole shell."""
        self.system.set(u)
        return float(fem.assemble_scalar(self._volume))

    def deflection(self, u: Vector, point: str) -> float:
        """w/R = -W at the pole, where all named points are."""
        return -float(u[self._pole[0]])

    def displacement(self, u: Vector, point: str) -> Array:
        """u/R (3,) there."""
        return np.array([0.0, 0.0, u[self._pole[0]]])

    def loaded_deflection(self, u: Vector) -> float:
        """w/R conjugate to the force: at the pole, or averaged over its patch."""
        return -self.system.potential(u, "force") / self.force_unit

    @property
    def force_unit(self) -> float:
        """The force F R/(2 pi D) = 1, over E h R."""
        return 2 * np.pi * self.material.bending_stiffness

    def _term(self, e: Energy) -> FormTerm:
        energy = 2 * np.pi * e.of(jets.revolved(self.u))
        return FormTerm(e.name, energy, self.u, self.kernels, e.amplitude, linear=e.linear)

    def _force(self, force: Force, factory: EnergyFactory) -> LinearTerm:
        assert force.point == "pole"
        dofs, entries = self._patch(force.patch, factory) if force.patch else (self._pole, np.array([-1.0]))
        return LinearTerm("force", dofs, self.force_unit * entries, self.u, "force")

    def _patch(self, radius: float, factory: EnergyFactory) -> Entries:
        """l with l . u = average of -W over the patch, whose weight's integral has the same quadrature."""
        weighted = factory.patch(radius)
        one = fem.Constant(self.meridian.mesh, 1.0)
        total = fem.assemble_scalar(self.kernels.compile("patch weight", weighted(one)))
        load = fem.assemble_vector(self.kernels.compile("patch load", weighted(-ufl.TestFunction(self.V)[1]))).array
        dofs = np.flatnonzero(load).astype(np.int32)
        return dofs, load[dofs] / total
