"""Viscosity of a shell: stresses that follow the rates of its strains, in the elastic law's form.

Kelvin and Voigt: the stress of tau dE/dt and tau dK/dt. A branch of Maxwell, a spring g in series
with a dashpot: the stress of g q with dq/dt = dE/dt - q/tau, q of the membrane strain and of the
curvature. Rates are those of the exact strains, so that rigid motions are not damped. Strains are
known at the nodes of each cell and interpolated.

Forces are integrated over a step in time from u0 to u1, of length dt. A strain q that decays as
q/tau is integrated with the mean rate of E in the step and with its change since the last step.
Viscous stresses are given to forms as the strain whose elastic stress they are, by the law at small
strains. Interior edges, and those that hold the normal, open by a jump of the rotation, as in C0
interior penalty; moments do work on it. A held edge is a boundary edge that holds the normal or
lies on a mirror plane. A jet is a map's value and derivatives at a point; `domain.j0` is that of
the placement, `domain.jet(u)` that of a displacement. u and displacements are over R, stresses
over E.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from numpy.typing import NDArray
from petsc4py import PETSc
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.nonlocal_terms import Factors
from magshell_fenicsx.continuation.system import Amplitudes, State, Tangent, Vector, max_abs
from magshell_fenicsx.models.domains import HeldEdge, IntegrationDomain
from magshell_fenicsx.models.shell import densities, edges
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.law import Law, work
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.parts.natural.shape import covariant
from magshell_fenicsx.platform import compat

if TYPE_CHECKING:  # a run builds only one kind of model
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
STRAIN_SIZE = 12  # numbers of a strain and a change of curvature, symmetric tensors in space
VELOCITY_STEP_IN_THICKNESSES = (
    1e-3  # part of the thickness by which a velocity moves the shell for its rate of strain
)


@dataclass(frozen=True)
class Branch:
    """A branch of Maxwell: the modulus g of its spring over Young's, and its relaxation time."""

    modulus: float
    time: float


@dataclass(frozen=True)
class Memory:
    """History of the Maxwell branches after a step.

    Attributes
    ----------
    strains
        Strain q of each branch's spring, (cells, nodes, 12).
    rate
        Mean rate of the shell's strain along the last step, (cells, nodes, 12); None where the
        motion begins or turns a corner.
    dt
        Length of the last step.
    """

    strains: list[Array]
    rate: Array | None = None
    dt: float = 0.0


class Viscosity:
    """The viscous forces of a shell in motion; a `continuation.motion.ViscousForces`.

    Construction compiles kernels. Strains are (cells, nodes, 12): six components each of the
    membrane strain E and of the change of curvature K, at the nodes of every cell.

    Parameters
    ----------
    model
        A shell or a meridian.
    mu
        Amplitudes of the motion, which place the supports; supports do not move in it.
    kelvin
        Relaxation time tau of the Kelvin-Voigt element; zero without.
    branches
        Maxwell branches.

    Attributes
    ----------
    memory
        History variables after the steps so far.
    creep_time
        `kelvin`: the longest time in which the forces let a displacement creep to its end.
    _model, _mu, _branches
        The parameters `model`, `mu` and `branches`.
    _jets, _frame
        Function that gives the jets of nodal values at the nodes of cells, and the frame in which
        these give strains.
    _field, _places
        Field of the stress in the forms, and the numbers of its nodes in each cell.
    _prescribed
        What the forms take: the stress, and the opening of edges.
    _forms
        Compiled gradients by u of the works of viscous stresses, whose sum is the force.
    _elastic_terms
        Names of the elastic terms.
    _viscous_tangent
        Tangent of the viscous forces; None where it is a multiple of the elastic one.
    _first_strain, _last_strain
        The last two displacements with their strains.
    _force
        The force that was returned last.
    """

    def __init__(
        self,
        model: "ShellModel | MeridianModel",
        mu: Amplitudes,
        kelvin: float,
        branches: Sequence[Branch],
    ) -> None:
        """Compile the forms of viscous forces; parameters are those of the class."""
        self._model, self._mu, self._branches, self.creep_time = model, dict(mu), branches, kelvin
        V, domain = model.V, model.factory.domain
        Q = domain.discontinuous(STRAIN_SIZE)
        self._jets = domain.tables(V, Q.element.basix_element.points)
        self._frame = TangentFrame.from_jet(self._jets(model.r0.x.array))
        self._field, self._places = fem.Function(Q, name="viscous"), Q.dofmap.list
        self._prescribed = _PrescribedStress(
            field=self._field,
            first_displacement=fem.Function(V),
            last_displacement=fem.Function(V),
            stiffness=fem.Constant(V.mesh, 0.0),
        )
        works = _works(model, self._prescribed)
        gradients = [
            ufl.derivative(domain.revolution_factor * work, model.u, ufl.TestFunction(V))
            for work in works
        ]
        self._forms = [
            model.kernels.compile(f"viscous residual {i}", form) for i, form in enumerate(gradients)
        ]
        self._elastic_terms = [
            term.name for term in model.system.terms if term.column in ("stretching", "bending")
        ]
        # where the law is linear, the viscous tangent is a multiple of the elastic one
        law = model.material.law
        self._viscous_tangent = _AddedViscousTangent(model) if law.linear != law else None
        self.memory = Memory([np.zeros((*self._places.shape, STRAIN_SIZE)) for _ in branches])
        # displacements and their strains, kept from one call to the next
        self._first_strain: tuple[Vector, Array] = np.empty(0), np.empty(0)
        self._last_strain: tuple[Vector, Array] = self._first_strain
        self._force = np.zeros(model.system.size)

    def force(self, u0: Vector, u1: Vector, v: Vector, part: float, dt: float) -> Vector:
        """Return the viscous forces at a fraction of the step from u0 to u1; collective.

        Parameters
        ----------
        v
            Velocity at that fraction of the step.
        part
            The fraction, from 0 to 1.
        dt
            Length of the step; 0 at the begin of a motion.
        """
        displacement = u0 + part * (u1 - u0)
        if self.creep_time:
            stress = self.creep_time * self._strain_rate(displacement, v)
        else:
            stress = np.zeros((*self._places.shape, STRAIN_SIZE))
        if self._branches:
            # strains of the springs at the begin and at the end of the step; linear in between
            first_strains, last_strains = self.memory.strains, self._evolved(u0, u1, dt)
            for branch, first, last in zip(
                self._branches, first_strains, last_strains, strict=True
            ):
                stress += branch.modulus * (part * last + (1 - part) * first)
        # edges have no history: at the middle of a step, the rate of an opening since its begin is
        # 2/dt times the opening
        edge_stiffness = self.stiffness(dt, rate=2 / dt) if dt else 0.0
        self._force = self._forces(stress, u0, displacement, edge_stiffness)
        return self._force

    def tangent(self, u: Vector, mu: Amplitudes, dt: float, rate: float) -> Tangent:
        """Return the system's tangent with the derivative of these forces by u1; collective.

        Viscous forces stiffen the shell, but no body that it touches. So only the elastic terms of
        the tangent grow. `rate` is dv/du at the end of the step, of length `dt`.
        """
        stiffness = self.stiffness(dt, rate)
        if self._viscous_tangent is None:
            return self._model.system.tangent(
                u, mu, times=dict.fromkeys(self._elastic_terms, 1 + stiffness)
            )
        with self._viscous_tangent.scaled_by(stiffness):
            return self._model.system.tangent(u, mu)

    def stiffness(self, dt: float, rate: float) -> float:
        """Return the viscous tangent over the elastic one for a step of length `dt`.

        `rate` is dv/du at the end of the step. A branch adds its modulus times the derivative of
        its spring's strain at the end of the step, by the change of the shell's strain in it.
        """
        return self.creep_time * rate + sum(
            b.modulus * (_retained_share(b, dt) + self._rate_change_factor(b, dt) / dt)
            for b in self._branches
        )

    def begin(self) -> None:
        """Forget the last rate of strain: a motion begins or turns a corner."""
        self.memory = Memory(self.memory.strains)

    def accept(self, u0: Vector, u1: Vector, dt: float) -> Vector:
        """Accept the step from u0 to u1, and return the force that it was solved with; collective.

        The history variables move on to u1.
        """
        if self._branches:
            self.memory = Memory(
                self._evolved(u0, u1, dt), np.asarray(self._strain_change(u0, u1) / dt), dt
            )
        return self._force

    def error_force(self, u0: Vector, u1: Vector, dt: float) -> Vector | None:
        """Return the force at u1 due to the second derivative of the strain in time.

        It is an estimate of the step's error. None for the first step after `begin`, where no
        earlier rate is known. Collective.
        """
        last_rate = self.memory.rate
        if last_rate is None:
            return None
        change_of_rate = self._strain_change(u0, u1) / dt - last_rate
        # moduli times the factors from this change to the strains of the springs
        factor = sum(b.modulus * self._rate_change_factor(b, dt) for b in self._branches)
        # edges have no part in the estimate: they open from u1 to u1, with zero stiffness
        return self._forces(factor * change_of_rate, u1, u1, stiffness=0.0)

    def _forces(self, stress: Array, u0: Vector, u1: Vector, stiffness: float) -> Vector:
        """Return the forces of a stress at nodes and of edges that open from u0 to u1; collective.

        Parameters
        ----------
        stress
            (cells, nodes, 12), given as the strain whose elastic stress it is.
        u0, u1
            Displacements between which edges open; the forces are those at u1.
        stiffness
            Viscous over elastic stiffness of edges.
        """
        prescribed, system = self._prescribed, self._model.system
        self._field.x.array.reshape(-1, STRAIN_SIZE)[self._places] = stress
        prescribed.stiffness.value = stiffness
        # edges open between these displacements
        for field, displacement in (
            (prescribed.first_displacement, u0),
            (prescribed.last_displacement, u1),
        ):
            field.x.array[:] = system.with_ghosts(displacement, self._mu)
        # gradient of the works by u, at u1
        return system.at_state(State(u1, self._mu)).gradient(self._forms)

    def _evolved(self, u0: Vector, u1: Vector, dt: float) -> list[Array]:
        """Return the strain q of each branch at the end of a step, (cells, nodes, 12).

        It integrates dq/dt = dE/dt - q/tau exactly for a strain E that is quadratic in time,
        through both ends of the step and the begin of the step before.
        """
        strain_change, last_rate = self._strain_change(u0, u1), self.memory.rate
        change_of_rate = 0.0 if last_rate is None else strain_change / dt - last_rate
        evolved = []
        for b, q in zip(self._branches, self.memory.strains, strict=True):
            decayed = np.exp(-dt / b.time) * q
            by_mean_rate = _retained_share(b, dt) * strain_change
            by_change_of_rate = self._rate_change_factor(b, dt) * change_of_rate
            evolved.append(np.asarray(decayed + by_mean_rate + by_change_of_rate))
        return evolved

    def _rate_change_factor(self, branch: Branch, dt: float) -> float:
        """Return the factor from a change in the mean strain rate to the strain of a spring.

        The change is from the last step to this one, of length `dt`. The strain is the part of that
        at the end of this step which it causes. The factor is a time; zero without an earlier rate.
        """
        if self.memory.rate is None:
            return 0.0
        # d²E/dt² is the change of mean rates over the mean length of both steps; this integral
        # weighs its effect with the decay
        decay_integral = _weighted_decay(dt / branch.time)
        return decay_integral * dt * 2 * dt / (dt + self.memory.dt)

    def _strain_change(self, u0: Vector, u1: Vector) -> Array:
        """Return the strain at u1 minus that at u0; collective.

        The strains of the last two displacements are kept, by identity of the arrays: solvers call
        this often with the same ones.
        """
        if self._first_strain[0] is not u0:
            if self._last_strain[0] is u0:  # the next step begins where the last one ended
                self._first_strain = self._last_strain
            else:
                self._first_strain = (u0, self._strain(u0))
        if self._last_strain[0] is not u1:
            self._last_strain = u1, self._strain(u1)
        (_, strain_before), (_, strain_after) = self._first_strain, self._last_strain
        return strain_after - strain_before

    def _strain_rate(self, u: Vector, v: Vector) -> Array:
        """Return the rate of strain at u along v, by a central difference; collective."""
        speed = max_abs(self._model.system.comm, v)
        if speed == 0:
            return np.zeros((*self._places.shape, STRAIN_SIZE))
        # a time in which the shell moves by a small part of its thickness
        step = VELOCITY_STEP_IN_THICKNESSES * self._model.material.h / speed
        return np.asarray((self._strain(u + step * v) - self._strain(u - step * v)) / (2 * step))

    def _strain(self, u: Vector) -> Array:
        """Return E and K (cells, nodes, 12) of a displacement as tensors in space.

        E is the membrane strain, K the change of curvature. Each of both gives its components xx,
        yy, zz, xy, xz, yz.
        """
        jets = self._jets(self._model.system.with_ghosts(u, self._mu))
        tensors = [  # 3 x 3 in space, from components along the coordinates of the surface
            self._frame.tensor(S)
            for S in (self._frame.membrane_strain(jets), self._frame.curvature_change(jets))
        ]
        rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # xx, yy, zz, xy, xz, yz
        return np.concatenate([S[..., rows, columns] for S in tensors], axis=-1)


class _AddedViscousTangent:
    """Tangent of viscous forces whose law is not that of the elastic ones.

    It is an `AddedTangent`, a matrix that the system adds to its own. Viscous stresses follow the
    law at small strains, while the elastic law, as of rubber, changes with the strain. So the
    viscous tangent is no multiple of the elastic one.

    Attributes
    ----------
    _system
        System of the model.
    _stiffness
        Factor of this tangent in the system's; zero outside `scaled_by`.
    _since
        Displacement at which the changes of strains are taken.
    _forms, _added
        Compiled forms of the tangent, and the matrix for their sum.
    """

    def __init__(self, model: "ShellModel | MeridianModel") -> None:
        """Compile the forms and add this tangent to those of the model's system."""
        self._system, self._stiffness = model.system, fem.Constant(model.V.mesh, 0.0)
        rates, v = _StrainRates(model), ufl.TestFunction(model.V)
        # the factor is 2 pi on a meridian, where integrals are per radian; else 1
        self._since, factor = rates.since, model.factory.domain.revolution_factor
        self._forms = [
            model.kernels.compile(
                f"viscous tangent {i}", factor * self._stiffness * ufl.derivative(work, model.u, v)
            )
            for i, work in enumerate(_works(model, rates))
        ]
        self._added = fem_petsc.create_matrix(self._forms[0])
        self._system.added_tangents.append(self)

    @contextmanager
    def scaled_by(self, stiffness: float) -> Iterator[None]:
        """Add this tangent, times a stiffness, to the system's tangents within the context."""
        self._stiffness.value = stiffness
        try:
            yield
        finally:
            self._stiffness.value = 0.0

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """Return the sparse tangent K plus the viscous one, as a new matrix; collective.

        Outside `scaled_by` it is K itself. `factors`, of the system's terms, are not used.
        """
        if not self._stiffness.value:
            return K
        self._since.x.array[:] = self._system.u.x.array
        self._added.zeroEntries()
        for form in self._forms:
            compat.add_matrix(self._added, form, self._system.clamped)
        self._added.assemble()
        stiffer = K.copy()
        stiffer.axpy(1.0, self._added, PETSc.Mat.Structure.UNKNOWN_NONZERO_PATTERN)
        return stiffer

    def times(self, v: Array, factors: Factors) -> Array:
        """Return zero, as the product of this tangent with the vector v of a support's motion.

        Supports do not move in a motion with viscous forces. `factors` are not used here.
        """
        return np.zeros_like(v)


def _retained_share(branch: Branch, dt: float) -> float:
    """Return the part of a step's strain that a spring still holds at its end, the rest decayed.

    The strain grows evenly in the step. The part is (1 - exp(-dt/tau)) tau/dt, or 1 for dt = 0.
    """
    return float(-np.expm1(-dt / branch.time) * branch.time / dt) if dt else 1.0


def _weighted_decay(z: float) -> float:
    """Return the integral of exp(-z (1 - s)) (s - 1/2) over a step, s from 0 to 1.

    exp is the decay of a strain from s to the end of the step, and s - 1/2 the part of its rate
    that a second derivative in time adds to the mean rate. z is the step over the relaxation time;
    a series takes the place of the formula at small z.
    """
    if z < 1e-2:
        return z / 12 - z**2 / 24 + z**3 / 80
    return float((1 + np.exp(-z)) / (2 * z) + np.expm1(-z) / z**2)


@dataclass(frozen=True)
class _PrescribedStress:
    """Given stresses and displacements, from which viscous forces follow.

    Attributes
    ----------
    field
        (12,) strain and change of curvature whose elastic stress is the viscous one, at nodes.
    first_displacement, last_displacement
        Displacements between which edges open.
    stiffness
        Viscous over elastic stiffness of edges.
    """

    field: fem.Function
    first_displacement: fem.Function
    last_displacement: fem.Function
    stiffness: fem.Constant

    def strain(self, j: Jet, side: str) -> tuple[Expr, Expr]:
        """Return strain and change of curvature whose elastic stress is the viscous one.

        `j` is the jet of the placement. `side` is "+" or "-" on an interior edge, "" within a cell.
        """
        stress = self.field(side) if side else self.field
        # tensors in the coordinates, from the components in space that begin at 0 and at 6
        return covariant(j, stress, 0), covariant(j, stress, 6)

    def stiff_opening(self, domain: IntegrationDomain, jump: Callable[[Jet], Expr]) -> Expr:
        """Return the stiffness times the opening of an edge between both displacements.

        `jump` gives the edge's jump as a function of the deformed jet.
        """
        jump_after, jump_before = (
            jump(domain.j0 + domain.jet(field))
            for field in (self.last_displacement, self.first_displacement)
        )
        return self.stiffness * (jump_after - jump_before)


class _StrainRates:
    """Derivatives of strains and jumps along a change of the displacement, a trial function.

    They replace `_PrescribedStress` in the forms of the tangent of viscous forces.

    Attributes
    ----------
    since
        Displacement at which the derivatives are taken.
    _change, _jet
        The trial function, and the jet of `since`.
    """

    def __init__(self, model: "ShellModel | MeridianModel") -> None:
        self.since, self._change = fem.Function(model.V), ufl.TrialFunction(model.V)
        self._jet = model.factory.domain.jet(self.since)

    def strain(self, j: Jet, side: str) -> tuple[Expr, Expr]:
        """Return the changes of the membrane strain and of the change of curvature.

        `j` is the jet of the placement. `side` is "+" or "-" on an interior edge, "" within a cell.
        """
        E, K = _strains(j, self._jet.side(side) if side else self._jet)
        return ufl.derivative(E, self.since, self._change), ufl.derivative(
            K, self.since, self._change
        )

    def stiff_opening(self, domain: IntegrationDomain, jump: Callable[[Jet], Expr]) -> Expr:
        """Return the change of an edge's jump, without a stiffness: that multiplies the whole form.

        `jump` gives the edge's jump as a function of the deformed jet.
        """
        return ufl.derivative(jump(domain.j0 + self._jet), self.since, self._change)


def _strains(j: Jet, u: Jet) -> tuple[Expr, Expr]:
    """Return membrane strain and change of curvature at the jets of placement and displacement."""
    return kin.membrane_strain(j, u), kin.curvature_change(j, u)


def mirrored_jump(r0: Jet, m: Expr, normal: Expr) -> Callable[[Jet], Expr]:
    """Return half the rotation jump across a mirror plane, as a function of the deformed jet.

    `m` is the covector of the edge, `normal` the plane's unit normal. For small
    angles it is the angle between the shell's normal and the plane.
    """
    nu1, nu2, _ = kin.conormal(r0, m)
    return lambda r: ufl.dot(kin.normal(r), normal) * ufl.dot(normal, r.r1 * nu1 + r.r2 * nu2)


def held_jump(r0: Jet, m: Expr, n0: Expr) -> Callable[[Jet], Expr]:
    """Return the jump to a held normal n0 at an edge, as a function of the deformed jet.

    `m` is the covector of the edge. The jump, for small angles, is the rotation of the shell's
    normal from n0 about the edge.
    """
    nu1, nu2, _ = kin.conormal(r0, m)
    return lambda r: -ufl.dot(n0 - kin.normal(r), r.r1 * nu1 + r.r2 * nu2)


def _jump_of(edge: HeldEdge, r0: Jet, m: Expr) -> Callable[[Jet], Expr]:
    """Return the rotation jump of a held edge as a function of the deformed jet.

    `r0` is the jet of the placement, `m` the covector of the edge.
    """
    if edge.plane is not None:  # an edge on a mirror plane with this normal
        return mirrored_jump(r0, m, edge.plane)
    # the normal is held at that of the placement, which a moving support turns
    n0 = kin.normal(r0)
    return held_jump(r0, m, n0 if edge.turn is None else ufl.dot(edge.turn, n0))


def _works(
    model: "ShellModel | MeridianModel", stresses: _PrescribedStress | _StrainRates
) -> list[ufl.Form]:
    """Return the works of viscous stresses on strains, and on edges as in C0 interior penalty.

    The first form holds cells and interior edges, and each further one a held edge. Smooth surfaces
    have no jumps, so that edges need no memory: each step closes the edges that it opens.

    Parameters
    ----------
    stresses
        Given stresses: then the gradients of the works by u are the viscous forces. Or changes of
        strain along a trial function: then these gradients are the tangent of the forces.
    """
    inner_work = _work_in_cells(model, stresses) + _work_on_interior_edges(model, stresses)
    return [inner_work, *_works_on_held_edges(model, stresses)]


def _small_strain_law(model: "ShellModel | MeridianModel", j: Jet, side: str = "") -> Law:
    """Return the shell's law at small strains, which viscous stresses follow.

    `j` is the jet of the placement. `side` is "+" or "-" on an interior edge, "" elsewhere.
    """
    thickness, materials = model.factory.thickness, model.factory.cell_materials
    law = densities.law_at(model.material.law.linear, j)
    if thickness is not None:
        law = law.thicker((thickness(side) if side else thickness)[0])
    if materials is None:
        return law
    material_numbers = materials(side) if side else materials
    # modulus, Poisson's ratio and law of the cell; 2 is the mass density
    return law.with_material(*(material_numbers[i] for i in (0, 1, 3)))


def _work_in_cells(
    model: "ShellModel | MeridianModel", stresses: _PrescribedStress | _StrainRates
) -> ufl.Form:
    """Return the work of viscous membrane stresses and moments on the strains of u in the cells."""
    domain = model.factory.domain
    r0, u = domain.j0, domain.jet(model.u)
    E, K = _strains(r0, u)
    strain, bend = stresses.strain(r0, "")
    inverse_metric, law = kin.inverse_metric(r0), _small_strain_law(model, r0)
    stretching = work(law.stress(strain, inverse_metric), E)
    bending = work(law.moment(strain, bend, inverse_metric), K)
    # in laminates, a viscous bend makes membrane stress, too
    coupling = work(law.moment(E, 0 * K, inverse_metric), bend)
    return (stretching + bending + coupling) * kin.area_ratio(r0) * domain.dx()


def _work_on_interior_edges(
    model: "ShellModel | MeridianModel", stresses: _PrescribedStress | _StrainRates
) -> ufl.Form:
    """Return the work of viscous moments on the rotation jumps between cells.

    As in C0 interior penalty it has three parts: viscous moment times jump of u, opening times
    elastic moment of u, and opening times penalty times jump. The opening is the change of the jump
    in the step, times the viscous stiffness.
    """
    factory, domain = model.factory, model.factory.domain
    r0, u, m = domain.j0, domain.jet(model.u), domain.covector
    sides = ("+", "-")
    r0s, us = [r0.side(s) for s in sides], [u.side(s) for s in sides]
    conormals = [kin.conormal(j, m(s)) for j, s in zip(r0s, sides, strict=True)]

    def jump_of(r: Jet) -> Expr:
        """Return the rotation jump at the deformed jet; a finite angle if the shell is folded."""
        plus, minus = (r.side(s) for s in sides)
        if factory.has_folds:
            return ufl.atan2(*edges.fold_angle(plus, minus, m("+")))
        return edges.fold_jump(plus, minus, conormals[0][:2], conormals[1][:2])

    # on each side: viscous moment, elastic moment, and stiffness of the penalty
    moments = list[tuple[Expr, Expr, Expr]]()
    for j, v, side, (nu1, nu2, _) in zip(r0s, us, sides, conormals, strict=True):
        # j and v are the jets of placement and displacement on this side; `edge` is the inverse
        # metric, the unit conormal, and its square, which is 1
        edge, law = (kin.inverse_metric(j), (nu1, nu2), 1), _small_strain_law(model, j, side)
        moments.append(
            (
                law.edge_moment(*stresses.strain(j, side), *edge),
                law.edge_moment(*_strains(j, v), *edge),
                law.edge_stiffness(kin.membrane_strain(j, v), *edge),
            )
        )
    widths = [
        edges.cell_width(r0s[i], domain.cell_area(sides[i]), conormals[i][2]) for i in range(2)
    ]
    given_moment, moment, side_stiffness = (
        edges.mean_by_width(pair, widths) for pair in zip(*moments, strict=True)
    )
    stiffness = side_stiffness * model.sigma / (sum(widths) / 2)
    opening, jump = stresses.stiff_opening(domain, jump_of), jump_of(r0 + u)
    # length of the edge over its length in coordinates
    stretch = (conormals[0][2] + conormals[1][2]) / 2
    return (given_moment * jump + opening * (moment + stiffness * jump)) * stretch * domain.dS()


def _works_on_held_edges(
    model: "ShellModel | MeridianModel", stresses: _PrescribedStress | _StrainRates
) -> list[ufl.Form]:
    """Return the works on edges that hold the normal or lie on mirror planes, one form each.

    As on interior edges a work has three parts, here with the moments of one side: viscous moment
    times jump of u, opening times elastic moment of u, and opening times penalty times jump. The
    opening is the change of the jump in the step, times the viscous stiffness.
    """
    factory, domain = model.factory, model.factory.domain
    r0, u, m = domain.j0, domain.jet(model.u), domain.covector
    E, K = _strains(r0, u)
    # components of the unit conormal, and length of the edge over its length in coordinates
    nu1, nu2, stretch = kin.conormal(r0, m)
    # `edge` is the inverse metric, the unit conormal, and its square, which is 1
    edge, law = (kin.inverse_metric(r0), (nu1, nu2), 1), _small_strain_law(model, r0)
    given_moment = law.edge_moment(*stresses.strain(r0, ""), *edge)
    moment = law.edge_moment(E, K, *edge)
    width = edges.cell_width(r0, domain.cell_area, stretch)
    stiffness = law.edge_stiffness(E, *edge) * model.sigma / width
    works = []
    for held_edge in factory.held_edges:
        jump_of = _jump_of(held_edge, r0, m)
        # the penalty acts on half the jump across a mirror plane
        modelled_sides = 1 if held_edge.plane is None else 2
        opening, jump = stresses.stiff_opening(domain, jump_of), jump_of(r0 + u)
        response = moment + modelled_sides * stiffness * jump
        density = given_moment * jump + opening * response
        works.append(density * stretch * domain.ds(held_edge.facets))
    return works
