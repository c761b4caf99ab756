"""Cache of scenes of problems that differ in values: it decides what a scene takes from another.

A scene is the model of a problem with its solver. A scene at other values takes, of these the
first that serves,

- all, where the values are known, or the strength of the magnetic field alone differs;
- the forms of a meridian, with other numbers in them (`SharedForms`);
- the model, with other fields in its coefficients (`update_fields`): remanence, thickness, natural
  curvature; the earlier scene is then this one;
- the mesh in the chart (`problem_on_mesh_of`), which may stretch with the chart
  (`problem_on_moved_mesh`);
- nothing.

Words and symbols:

- The chart has the coordinates of the undeformed surface; r0 maps it into space. A knot of a
  meridian is a value of its parameter at which cells must end, as at the rim of a dimple.
- Numbers are what the terms of a meridian take from its case: arrays, for each term in a fixed
  order.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.models.shell import spatial_fields
from magshell_fenicsx.models.shell.thickness import thickness_field
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.imperfections.imperfection import LocalSection
from magshell_fenicsx.parts.natural.shape import natural_field
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.scene import Scene, build_meridian_model

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
Numbers = dict[str, list[Array]]  # name of a term -> its numbers
# section -> keys of the fields that a scene can take from another problem
FIELD_KEYS = {"magnetic": {"remanent"}, "shell": {"thickness_factor"}, "natural": {"curvature"}}
BOUNDS_TOLERANCE = 1e-14  # of the bounds of charts that are the same


class UnfitMesh(CaseError):
    """A problem cannot have the mesh of another one; the message says why."""


class SceneCache:
    """Scenes of a case at several values; each takes from an earlier one what it can.

    Parameters
    ----------
    comm
        Ranks that share the scenes.
    base
        Scene whose mesh in the chart all others have; None: each problem has a mesh of its own.
    moves_mesh
        Whether the mesh of the base stretches where the chart changes its size.
    overwrites
        Whether an earlier scene is no longer needed once another one is asked for. Then its model
        gets other fields where these alone differ.
    max_unknowns
        Unknowns of all scenes that are remembered by their values; the latest is always.

    Attributes
    ----------
    _scenes
        Values -> the scene; the one that was used last stands last.
    _latest
        The scene that may be overwritten; None if there is none.
    _forms
        Forms of the base that other scenes share; None: each has its own.
    """

    def __init__(
        self,
        comm: MPI.Comm = MPI.COMM_WORLD,
        *,
        base: Scene | None = None,
        moves_mesh: bool = False,
        overwrites: bool = False,
        max_unknowns: float = inf,
    ) -> None:
        self.comm, self.base = base.comm if base else comm, base
        self._moves_mesh, self._overwrites = moves_mesh, overwrites
        self._max_unknowns = max_unknowns
        self._scenes: dict[Hashable, Scene] = {}
        self._latest: Scene | None = None
        self._forms: SharedForms | None = None

    def scene_at(self, values: Hashable, make_problem: Callable[[], Problem]) -> Scene:
        """Return the scene at some values, which is made at the first call; collective.

        A cache that overwrites its scene has no others.

        Parameters
        ----------
        values
            What tells the scene from the others of this cache.
        make_problem
            Makes the problem at these values, for `scene_for`.
        """
        assert not self._overwrites
        # taken out and put back, as the one that was used last
        scene = self._scenes.pop(values, None) or self.scene_for(make_problem())
        self._scenes[values] = scene
        while len(self._scenes) > 1 and self._unknowns > self._max_unknowns:
            self._scenes.pop(next(iter(self._scenes)))
        return scene

    @property
    def _unknowns(self) -> int:
        """Number of unknowns of all scenes that are remembered, on all ranks."""
        dofmaps = (scene.model.V.dofmap for scene in self._scenes.values())
        return sum(dofmap.index_map.size_global * dofmap.bs for dofmap in dofmaps)

    def scene_for(self, problem: Problem) -> Scene:
        """Return the scene of a problem, with what it can take from an earlier one; collective.

        Raises
        ------
        UnfitMesh
            If the problem cannot have the mesh of the base.
        MeshError
            If the scene cannot be made.
        """
        if self.base:
            problem = self._on_mesh_of_base(problem)
            scene = self._forms.scene_for(problem) if self._forms else None
            return scene or Scene(problem, self.comm)
        scene, self._latest = self._latest, None
        if scene is None or not update_fields(scene, problem):
            scene = Scene(problem, self.comm)
        self._latest = scene if self._overwrites else None
        return scene

    def _on_mesh_of_base(self, problem: Problem) -> Problem:
        """Return a problem on the mesh of the base.

        Raises
        ------
        UnfitMesh
            If its symmetry is another one, or the mesh cannot follow.
        """
        assert self.base
        same_symmetry = _symmetry(problem) == _symmetry(self.base.problem)
        if self._moves_mesh:
            if not same_symmetry:
                raise UnfitMesh(
                    "the symmetry of the model changes on the way: give the case symmetry: none"
                )
            return problem_on_moved_mesh(self.base, problem)
        if not same_symmetry:
            raise UnfitMesh(
                "a change of it breaks the symmetry of the model: give the case symmetry: none"
            )
        if problem.patched and _rims(problem) != _rims(self.base.problem):
            raise UnfitMesh(
                "moves the rim of a dimple, which is the edge of a patch in the mesh; a width with "
                "a unit depends on no other number"
            )
        return problem_on_mesh_of(self.base, problem)

    def share_forms(self) -> bool:
        """Let further scenes share the forms of the base; return whether it has such forms.

        The base must not be evaluated until `leave_forms`.
        """
        assert self.base
        self._forms = SharedForms.of_scene(self.base)
        return self._forms is not None

    def leave_forms(self) -> None:
        """Give the base its forms back; further scenes have their own."""
        assert self._forms
        self._forms.leave()
        self._forms = None


def with_strengths(scene: Scene, context: Context) -> Scene:
    """Return the scene of a case that differs by the strengths of its loads alone.

    It has the same model and solver. Neither is built again.

    Parameters
    ----------
    context
        What the sections of the other case have made of its file.
    """
    return scene.copied(problem=replace(scene.problem, context=context))


def _symmetry(problem: Problem) -> tuple[object, ...]:
    """Return what part of the shell the model of a problem has, and in which frame."""
    return problem.axisymmetric, problem.mirror, problem.azimuth


class SharedForms:
    """Forms of one meridian that the scenes of several problems share.

    Terms take what differs between two cases from the placement and from the parameters of their
    densities. So where two models have these alike, one of them serves both: each evaluation puts
    the numbers of its case in place first. The forms are a `SettableNumber` for this: the `value`
    says whose numbers are in place. The scene that has made the forms, which has the value 0, must
    not be evaluated until the others `leave` them.

    Parameters
    ----------
    scene
        The scene that has made the forms.
    places
        Name of a term -> the arrays of its model that the forms read.

    Attributes
    ----------
    _numbers
        The numbers of all scenes, by their values.
    """

    def __init__(self, scene: Scene, places: Numbers) -> None:
        self._scene, self._places = scene, places
        self._numbers, self._value = [_copied(places)], 0

    @staticmethod
    def of_scene(scene: Scene) -> "SharedForms | None":
        """Return the forms of a scene; None if other cases would differ in more than numbers."""
        places = scene.model.numbers() if scene.model.axisymmetric else None
        return SharedForms(scene, places) if places else None

    @property
    def value(self) -> float:
        """The value of the scene whose numbers are in place."""
        return self._value

    @value.setter
    def value(self, value: float) -> None:
        """Put the numbers of another scene in place."""
        if value == self._value:
            return
        self._value = int(value)
        for name, numbers in self._numbers[self._value].items():
            for place, number in zip(self._places[name], numbers, strict=True):
                place[...] = number

    def scene_for(self, problem: Problem) -> Scene | None:
        """Return the scene of a problem on the shared forms; None if these do not fit.

        They fit if the numbers of the problem's model have the same shapes.
        """
        # a model without forms, which only gives its numbers
        model = build_meridian_model(problem, assembled=False)
        numbers = model.numbers()
        if numbers is None or _shapes(numbers) != _shapes(self._places):
            return None
        self._numbers.append(_copied(numbers))
        assert self._scene.model.axisymmetric
        shared_model = self._scene.model.with_numbers(model, self, len(self._numbers) - 1)
        newton = BorderedNewton(shared_model.system, self._scene.newton.options)
        return self._scene.copied(problem=problem, model=shared_model, newton=newton)

    def leave(self) -> None:
        """Put the numbers of the scene that has made the forms in place again."""
        self.value = 0


def _shapes(numbers: Numbers) -> list[tuple[str, list[tuple[int, ...]]]]:
    """Return the shapes of the numbers of each term, by name."""
    return [(name, [np.shape(number) for number in of_term]) for name, of_term in numbers.items()]


def _copied(numbers: Numbers) -> Numbers:
    """Return a copy of the numbers of all terms."""
    return {name: list(map(np.array, of_term)) for name, of_term in numbers.items()}


def update_fields(scene: Scene, problem: Problem) -> bool:
    """Give a scene the remanence, thickness and natural curvature of a problem; collective.

    Returns
    -------
    bool
        Whether the problem differs in these alone and the scene has them as fields; if not, the
        scene stays as it is.

    Raises
    ------
    MeshError
        If a field has no fit value somewhere; the scene is unfit then.
    """
    model, old = scene.model, scene.problem
    has_same_data = _data_without_fields(old) == _data_without_fields(problem)
    # without data, as of a problem that a program has made, nothing can be compared
    if not (old.document.data and has_same_data):
        return False
    # solids, and models with contacts or dead loads, are always built anew
    if not model.thin or old.loads.dead:
        return False
    if model.all_contacts:
        return False
    if _symmetry(problem) != _symmetry(old) or _kinds_of_fields(problem) != _kinds_of_fields(old):
        return False
    if _has_fields_by_patch(problem) or _has_fields_by_patch(old):
        return False
    _set_fields(model, problem)
    model.loads = problem.loads
    scene.problem = problem
    # without what was known of the old fields: factors, and the state of the monitor
    scene.newton = BorderedNewton(model.system, scene.newton.options)
    scene.__dict__.pop("stability_monitor", None)
    return True


def _data_without_fields(problem: Problem) -> dict[str, Any]:
    """Return the data of a problem's case, key by key, without the fields that a scene can take."""
    return {
        key: _section_without_fields(key, section) for key, section in problem.document.data.items()
    }


def _section_without_fields(key: str, section: Any) -> Any:
    """Return the data of the section `key` without the fields that a scene can take."""
    if key not in FIELD_KEYS:
        return section
    return {name: value for name, value in section.items() if name not in FIELD_KEYS[key]}


def _kinds_of_fields(problem: Problem) -> tuple[bool | str | float, ...]:
    """Return which fields the terms of a problem have, to be compared with another problem.

    They are flags of remanence and thickness, the scale of a soft material (0.0 without one), and
    the amplitudes of the natural shape.
    """
    magnetic, natural = problem.loads.magnetic, problem.loads.natural
    amplitudes = natural.amplitudes if natural else ()
    soft_scale = magnetic.soft.scale if magnetic and magnetic.soft else 0.0
    has_remanence = callable(magnetic and magnetic.remanent)
    return has_remanence, problem.thickness is not None, soft_scale, *amplitudes


def _has_fields_by_patch(problem: Problem) -> bool:
    """Return whether a field of a problem is given by patches of a mesh."""
    magnetic, natural, thickness = problem.loads.magnetic, problem.loads.natural, problem.thickness
    has_natural_patches = natural is not None and any(
        isinstance(field, Mapping) for field in (natural.curvature, natural.stretch)
    )
    magnetic_patches = magnetic and magnetic.patches
    thickness_patches = thickness and thickness.patches
    return has_natural_patches or bool(magnetic_patches or thickness_patches)


def _set_fields(model: "ShellModel | MeridianModel", problem: Problem) -> None:
    """Put the fields of a problem into the coefficients of a model; collective."""
    magnetic, natural, r0 = problem.loads.magnetic, problem.loads.natural, model.r0
    # name -> coefficient of the terms' forms
    coefficients = {
        coefficient.name: coefficient
        for term in model.system.terms
        if isinstance(term, FormTerm)
        for coefficient in term.form.coefficients()
    }
    if magnetic and callable(magnetic.remanent):
        remanence, *_ = spatial_fields.pattern_field(magnetic.remanent, r0)
        coefficients["Br"].x.array[:] = remanence.x.array
    if problem.thickness and model.thickness:
        patches = model.midsurface.patches if model.midsurface else {}
        model.thickness.x.array[:] = thickness_field(problem.thickness, r0, patches).x.array
    if natural:
        curvature = natural_field(natural, spatial_fields.cell_geometry(r0), model.V)
        coefficients["natural"].x.array[:] = curvature.x.array


def _rims(problem: Problem) -> list[object]:
    """Return half-width and place of each rim of a dimple that is an edge of a patch."""
    shell = problem.context.shell
    local_imperfections = [
        section for section in problem.imperfections.values() if isinstance(section, LocalSection)
    ]
    return [
        (section.half_width(shell.R_over_h, shell.poisson_ratio), section.at)
        for section in local_imperfections
        if section.patch
    ]


def problem_on_mesh_of(scene: Scene, new_problem: Problem) -> Problem:
    """Return a problem on the mesh of a scene, whose nodes stay where they are in the chart.

    Their places in space follow from the new problem.

    Parameters
    ----------
    new_problem
        Problem that differs from the scene's in numbers alone, also of imperfections.
    """
    old, model = scene.problem, scene.model
    meridian, shape = old.meridian, old.shape
    if model.midsurface:
        shape = model.midsurface.with_embedding(new_problem.embedding)
    elif model.axisymmetric:
        assert new_problem.meridian
        meridian = replace(
            new_problem.meridian, vertices=np.sort(model.meridian.mesh.geometry.x[:, 0])
        )
    return replace(
        old,
        context=new_problem.context,
        body=new_problem.body,
        material=new_problem.material,
        loads=new_problem.loads,
        thickness=new_problem.thickness,
        embedding=new_problem.embedding,
        meridian=meridian,
        shape=shape,
    )


def problem_on_moved_mesh(scene: Scene, new_problem: Problem) -> Problem:
    """Return a problem on the mesh of a scene, which is stretched with the chart.

    A meridian's vertices move linearly between knots, the parameters at which cells must end. The
    nodes of a flat mesh move with the bounds of the chart.

    Raises
    ------
    UnfitMesh
        If the mesh cannot follow the change of the chart.
    """
    on_mesh, old = problem_on_mesh_of(scene, new_problem), scene.problem
    if on_mesh.meridian:
        assert old.meridian
        assert new_problem.meridian
        # parameters at which cells must end, such as rims
        knots, new_knots = old.meridian.knots, new_problem.meridian.knots
        if knots.shape != new_knots.shape:
            raise UnfitMesh("a rim of a dimple appears or vanishes on the way")
        vertices = on_mesh.meridian.vertices
        assert vertices is not None
        moved_vertices = np.interp(vertices, knots, new_knots)
        return replace(on_mesh, meridian=replace(on_mesh.meridian, vertices=moved_vertices))
    bounds, new_bounds = _chart_bounds(old.shape), _chart_bounds(new_problem.shape)
    if bounds is None or new_bounds is None:  # unknown: taken as the same
        return on_mesh
    if not scene.model.midsurface or np.allclose(bounds, new_bounds, 0, BOUNDS_TOLERANCE):
        return on_mesh
    patch = scene.model.midsurface.with_embedding(new_problem.embedding)
    if patch.nodes.shape[1] != 2:  # nodes of a mesh file have three coordinates
        raise UnfitMesh("the mesh of this shape cannot move with the number")
    (low, high), (new_low, new_high) = bounds, new_bounds
    nodes = new_low + (patch.nodes - low) / (high - low) * (new_high - new_low)
    return replace(on_mesh, shape=replace(patch, nodes=nodes), points=new_problem.points)


def _chart_bounds(shape: object) -> tuple[Array, Array] | None:
    """Return the bounds of the chart of a shape, lower and upper (2,); None if unknown.

    A disc has zeros and its radius in their place.
    """
    if isinstance(shape, Grid):
        return np.array(shape.low), np.array(shape.high)
    box: tuple[Array, Array] | None = getattr(shape, "box", None)
    radius = getattr(shape, "radius", None)
    return (np.zeros(2), np.full(2, radius)) if radius is not None else box
