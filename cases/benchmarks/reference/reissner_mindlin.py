"""A second discretisation of two benchmarks, for what transverse shear and the published mesh
contribute.

Reissner-Mindlin shell on an octant of a cylinder: displacement u and director d = d0 + v, both of
degree k on a grid of quadrilaterals; the corner A is moved radially in steps. Lengths as in the
case, energies over E h:

    membrane and bending   W(E) + h^2/12 W(K),    W(A) = ((1 - nu) A:A + nu tr^2 A) / (2 (1 -
    nu^2)),
                           E_ij = (r,i . r,j - ..)/2,    K_ij = sym(r,i . d,j) - ..
    shear                  kappa/(4 (1 + nu)) |r,i . d|^2
    |d| = 1                ((d . d - 1)/2)^2 / 2, as penalty

Degree 1 has one point, but for the part `--full` of membrane and bending: with 0.02 a stand-in for
S4R, whose hourglass stiffness is not known. A large `--kappa` leaves a Koiter shell. It shares
nothing with magshell_fenicsx.

    .ci/in-env python3 cases/benchmarks/reference/reissner_mindlin.py pullout 36 24 --degree 1 >
    out.csv
"""

import argparse
import sys
from dataclasses import dataclass

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc
from mpi4py import MPI
from petsc4py import PETSc

TOLERANCE, MOST = 1e-7, 12  # residual over the force at A; iterations of a step
GROWTH, EASY, SMALLEST = (
    1.5,
    5,
    1e-3,
)  # of steps: factor, iterations that allow it, over the largest


@dataclass(frozen=True)
class Problem:
    """An octant; `held`: on a diaphragm; `end`: of A; `load`: total force at load factor 1."""

    R: float
    L: float
    h: float
    E: float
    nu: float
    held: bool
    end: float
    load: float


PROBLEMS = {
    "pinched": Problem(100.0, 100.0, 1.0, 30e3, 0.3, held=True, end=-84.0, load=12e3),
    "pullout": Problem(4.953, 5.175, 0.094, 10.5e6, 0.3125, held=False, end=2.8, load=40e3),
}


def energy(p: Problem, U: fem.Function, kappa: float, full: float) -> list[ufl.Form]:
    """The elastic energy with U = (u, v), one form a rule: FFCx 0.9 makes a wrong kernel of their
    sum.
    """
    domain = U.function_space.mesh
    degree = U.function_space.element.basix_element.degree
    t = ufl.SpatialCoordinate(domain)[0] / p.R
    around, along = ufl.as_vector([-ufl.sin(t), ufl.cos(t), 0]), ufl.as_vector([0, 0, 1])
    u, v = (ufl.as_vector([U[i] for i in part]) for part in (range(3), range(3, 6)))
    d = ufl.as_vector([ufl.cos(t), ufl.sin(t), 0]) + v
    a0, d0 = (around, along), (around / p.R, 0 * along)
    a, da = ([x0[i] + x.dx(i) for i in range(2)] for x0, x in ((a0, u), (d0, v)))

    def symmetric(b, c, b0, c0):
        A = [[ufl.dot(b[i], c[j]) - ufl.dot(b0[i], c0[j]) for j in range(2)] for i in range(2)]
        return ufl.as_matrix([[(A[i][j] + A[j][i]) / 2 for j in range(2)] for i in range(2)])

    def W(A):
        return ((1 - p.nu) * ufl.inner(A, A) + p.nu * ufl.tr(A) ** 2) / (2 * (1 - p.nu**2))

    plane = W(symmetric(a, a, a0, a0) / 2) + p.h**2 / 12 * W(symmetric(a, da, a0, d0))
    shear = kappa / (4 * (1 + p.nu)) * sum(ufl.dot(a[i], d) ** 2 for i in range(2))
    length = ((ufl.dot(d, d) - 1) / 2) ** 2 / 2
    one, all_points = (ufl.dx(domain, metadata={"quadrature_degree": q}) for q in (1, 2 * degree))
    if degree == 1:
        parts = [(full * plane + length) * all_points, ((1 - full) * plane + shear) * one]
    else:
        parts = [(plane + shear + length) * all_points]
    return [p.E * p.h * part for part in parts]


class Shell:
    """Residual, tangent and supports; the unknowns are (u, v) at the nodes."""

    def __init__(
        self, p: Problem, cells: tuple[int, int], degree: int, kappa: float, full: float
    ) -> None:
        self.p, corner = p, np.array([p.R * np.pi / 2, p.L])
        domain = mesh.create_rectangle(
            MPI.COMM_SELF, [[0, 0], corner], cells, mesh.CellType.quadrilateral
        )
        V = fem.functionspace(
            domain, basix.ufl.element("Lagrange", domain.basix_cell(), degree, shape=(6,))
        )
        self.U = fem.Function(V)
        residuals = [ufl.derivative(part, self.U) for part in energy(p, self.U, kappa, full)]
        self.F = [fem.form(residual) for residual in residuals]
        self.J = [fem.form(ufl.derivative(residual, self.U)) for residual in residuals]
        self.K, self.b = petsc.create_matrix(self.J[0]), petsc.create_vector(self.F[0])
        self.ksp = PETSc.KSP().create(MPI.COMM_SELF)
        self.ksp.setType("preonly")
        self.ksp.getPC().setType("cholesky")
        self.ksp.getPC().setFactorSolverType("mumps")
        x = V.tabulate_dof_coordinates()[:, :2]
        sides = [
            np.flatnonzero(np.isclose(x[:, i], end)) for i in range(2) for end in (0.0, corner[i])
        ]
        planes = [(sides[0], (1, 4)), (sides[1], (0, 3)), (sides[2], (2, 5))] + [
            (sides[3], (0, 1))
        ] * p.held
        zero = np.concatenate(
            [6 * nodes + component for nodes, both in planes for component in both]
        )
        self.A, self.B, self.C = (
            6 * int(np.intersect1d(sides[i], sides[j])[0]) + component
            for i, j, component in ((0, 2, 0), (1, 2, 1), (1, 3, 1))
        )
        self.fixed = np.union1d(zero, [self.A]).astype(np.int32)

    def residual(self) -> np.ndarray:
        with self.b.localForm() as local:
            local.set(0)
        for form in self.F:
            petsc.assemble_vector(self.b, form)
        return self.b.array.copy()

    def step(self, residual: np.ndarray) -> np.ndarray:
        """A Newton step with the supports and A held."""
        self.K.zeroEntries()
        for form in self.J:
            petsc.assemble_matrix(self.K, form)
        self.K.assemble()
        self.K.zeroRowsColumns(self.fixed, 1.0)
        self.ksp.setOperators(self.K)
        right, found = self.b.duplicate(), self.b.duplicate()
        right.array[:] = np.where(np.isin(np.arange(len(residual)), self.fixed), 0.0, -residual)
        self.ksp.solve(right, found)
        return found.array.copy()

    def solve(self) -> tuple[int, float]:
        """Iterations (0 if lost) and the force at A."""
        for iteration in range(MOST + 1):
            R = self.residual()
            force, rest = R[self.A], np.delete(R, self.fixed)
            if iteration and np.linalg.norm(rest) < TOLERANCE * max(abs(force), 1e-3 * self.p.load):
                return iteration, force
            step = self.step(R)
            largest = np.abs(step.reshape(-1, 6)).max(axis=0)
            excess = max(largest[:3].max() / (0.15 * self.p.R), largest[3:].max() / 0.5)
            self.U.x.array[:] += step / max(1.0, excess)
        return 0, 0.0


def main() -> None:
    """Print load factor, u_x of A, u_y of B and of C."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("problem", choices=PROBLEMS)
    parser.add_argument("around", type=int)
    parser.add_argument("along", type=int)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--kappa", type=float, default=5 / 6)
    parser.add_argument("--full", type=float, default=0.02)
    parser.add_argument("--steps", type=int, default=40)
    given = parser.parse_args()
    p = PROBLEMS[given.problem]
    shell = Shell(p, (given.around, given.along), given.degree, given.kappa, given.full)
    u = shell.U.x.array
    largest = p.end / given.steps
    step, before, here = np.sign(p.end) * p.h / 10, (0.0, u.copy()), (0.0, u.copy())
    print("load_factor,A_ux,B_uy,C_uy")
    while abs(here[0]) < abs(p.end):
        target = min(here[0] + step, p.end, key=abs)
        if here[0]:
            u[:] += (here[1] - before[1]) * (target - here[0]) / (here[0] - before[0])
        u[shell.A] = target
        iterations, force = shell.solve()
        if not iterations:
            u[:] = here[1]
            step /= 2
            if abs(step) < SMALLEST * abs(largest):
                sys.exit("lost")
            continue
        print(
            *(f"{x:.9g}" for x in (4 * abs(force) / p.load, target, u[shell.B], u[shell.C])),
            sep=",",
            flush=True,
        )
        before, here = here, (target, u.copy())
        if iterations <= EASY:
            step = min(GROWTH * step, largest, key=abs)


if __name__ == "__main__":
    main()
