"""Gradients after a run: derivatives of its results by numbers and fields.

A result is a number of the run, such as "knockdown", or a column of path.csv at the end of the
path. A parameter is what it is differentiated by: a number of the case, an amplitude (load
parameter), or a whole field, such as the thickness. One adjoint solve gives all derivatives of a
result. Those by a field are a density, per area of the undeformed shell. A scene is the model of a
problem with its solver. A model of half a shell has the multiplicity 2. `say` prints a line of
text.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.output.fields.gathering import Gatherer, gatherer
from magshell_fenicsx.output.fields.mode_fields import columns_of, gradient_file
from magshell_fenicsx.output.fields.surface import Surface, completed_by_symmetry, rotated_surface
from magshell_fenicsx.output.fields.vtu import ShellData, vtu_content
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import access_disk
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.follow import BEYOND_INSTABILITY
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint
from magshell_fenicsx.simulate.gradients.fields import density
from magshell_fenicsx.simulate.gradients.gradient import Gradient, derivative
from magshell_fenicsx.simulate.gradients.instabilities import (
    FOLDS,
    LostResult,
    instabilities,
    refuse_moving,
)
from magshell_fenicsx.simulate.gradients.results import (
    adjoint_at_end,
    refuse_no_result,
    refuse_unknown_parameters,
)
from magshell_fenicsx.simulate.scene import Scene

Say = Callable[[str], None]
ROUNDING = 1e-10  # relative: a smaller component is zero
Array = NDArray[np.float64]


def refuse_unknown(scene: Scene) -> None:
    """Check, before the run of a scene, that the requested gradients can be computed.

    A scene is the model of a problem with its solver.

    Raises
    ------
    CaseError
        If the case has no such result or parameter.
    """
    section, start = scene.problem.gradients, scene.unloaded()
    if section is None:
        return
    refuse_no_result(scene, section.of, "gradients.of")
    refuse_unknown_parameters(scene.problem.context, section.by, start)


def gradients_after(result: Result, folder: Path | None, say: Say) -> None:
    """Compute the requested gradients of a run, and print them; collective.

    They are added to `result.gradients`. With a folder, fields/gradients_*.vtu are written as well.
    A warning names a gradient that cannot be computed.

    Raises
    ------
    DiskError
        On every rank, if something cannot be written.
    """
    section = result.scene.problem.gradients
    if section is None:
        return
    for name in section.of:
        try:
            kind, adjoint = _adjoint(result, name)
        except (CaseError, FoldLost, LostResult) as e:
            say(f"warning: no gradient of {name}: {e}")
            continue
        gradients = _gradients(adjoint, name, section.by, say)
        if gradients:
            _report(result, name, kind, adjoint, gradients, folder, say)


def _report(
    result: Result,
    name: str,
    kind: str,
    adjoint: Adjoint,
    gradients: Mapping[str, Gradient],
    folder: Path | None,
    say: Say,
) -> None:
    """Keep the gradients of a result in the run's result, write and print them; collective.

    Gradients by numbers are printed as derivatives. Those by fields are printed as the derivative
    by a uniform change, and the place where the gradient per area is largest.

    Parameters
    ----------
    name, kind
        Name of the result, such as "knockdown", and kind of its point.
    adjoint
        The solved adjoint problem of the result.
    gradients
        Parameter -> derivative by it: a number, or a field.
    folder
        Folder of the run; None if nothing is written.
    """
    fields, slopes = dict[str, FieldGradient](), dict[str, float]()
    for parameter, gradient in gradients.items():
        if isinstance(gradient, FieldGradient):
            fields[parameter] = gradient
        else:
            slopes[parameter] = float(gradient)
    file = gradient_file(folder, name) if folder else None
    entry_of_field = _entries_of_fields(adjoint, fields, file) if fields else {}
    result.gradients[name] = {
        "value": adjoint.value_in_unit,
        "kind": kind,
        "numbers": slopes,
        "fields": entry_of_field,
    }
    for parameter, entry in entry_of_field.items():
        # a component that is only rounding is shown as zero: of the derivative beside the largest
        # density, of the place (over R) beside R
        uniform = _words(entry["alike"], size=entry["most_per_area"], digits=6)
        place = _words(entry["at"], size=1.0, digits=3)
        say(
            f"d {name}/d {parameter}: {uniform} for a change that is the same everywhere, "
            f"most per area at ({place})"
        )
    for parameter, slope in slopes.items():
        say(f"d {name}/d {parameter}: {slope:.6g}")


def _entries_of_fields(
    adjoint: Adjoint, fields: Mapping[str, FieldGradient], file: Path | None
) -> dict[str, dict[str, Any]]:
    """Return the numbers about gradients by fields, by parameter, and write the file; collective.

    The keys of an entry are those of summary.json: `alike` is the derivative by a uniform change,
    `most_per_area` the largest norm of the gradient per area, and `at` the place where it is.

    Parameters
    ----------
    fields
        Parameter -> gradient by it; at least one.
    file
        File for the shell with the gradients as fields; None if it is not written.
    """
    scene = adjoint.scene  # that of the end, which may be of another model
    entry_of_field: dict[str, dict[str, Any]] = {
        parameter: {"alike": _by_uniform_change(scene, parameter, gradient)}
        for parameter, gradient in fields.items()
    }
    # rank 0 has the surface, and tells the others what it finds there
    surface = _surface(scene, adjoint, fields)
    largest: dict[str, dict[str, Any]] = {}
    if surface:
        largest = {parameter: _largest_density(surface, parameter) for parameter in fields}
    for parameter, entry in scene.comm.bcast(largest).items():
        entry_of_field[parameter] |= entry
    if file:
        access_disk(scene.comm, partial(_write, file, surface, scene))
    return entry_of_field


def _gradients(
    adjoint: Adjoint, name: str, parameters: Sequence[str], say: Say
) -> dict[str, Gradient]:
    """Return the derivatives of a result by each parameter; collective.

    A warning names parameters by which it cannot be differentiated.
    """
    gradients = dict[str, Gradient]()
    for parameter in parameters:
        try:
            gradients[parameter] = derivative(adjoint, parameter)
        except (CaseError, FoldLost, LostResult) as e:
            say(f"warning: no gradient of {name} by {parameter}: {e}")
    return gradients


def _words(values: Sequence[float], size: float, digits: int) -> str:
    """Return numbers as text with some digits; those that are rounding beside `size` are zero."""
    rounded = [value if abs(value) > ROUNDING * size else 0.0 for value in values]
    return ", ".join(f"{value:.{digits}g}" for value in rounded)


def _write(file: Path, surface: Surface | None, scene: Scene) -> None:
    """Write a surface with its fields as a file of VTK; on rank 0."""
    assert surface
    material = scene.problem.material
    write_whole(file, vtu_content(surface, ShellData(material.h, material.nu)))


def _adjoint(result: Result, name: str) -> tuple[str, Adjoint]:
    """Return the kind of the point of a result, and the adjoint that gives its derivatives.

    `name` is that of the result, such as "knockdown" or a column of path.csv.

    Raises
    ------
    LostResult
        If the run has no such result.
    """
    scene, history = result.scene, result.path_history
    # a result at the first instability of the path, which comes as (kind, adjoint)
    if name in FOLDS:
        first_kind_and_adjoint, *_ = instabilities(
            scene, history.located, name, max_count=1, begins=history.begins
        )
        return first_kind_and_adjoint
    # a result at the end; a path that has not reached its end has none
    reason = next(
        (remark for remark in result.remarks if remark.startswith(BEYOND_INSTABILITY)), None
    )
    obstacle = result.stopped or reason
    if obstacle or history.end is None:
        raise LostResult(obstacle or "the path has no end")
    refuse_moving(scene, history.end, name)
    return adjoint_at_end(scene, history, name)


def _by_uniform_change(scene: Scene, parameter: str, gradient: FieldGradient) -> list[float]:
    """Return the derivative by a change of a field that is the same everywhere.

    There is one number for each component. Vectors are in the frame of the case; on a meridian they
    are along e_rho and e_z.
    """
    # the sum over all cells
    uniform_derivative = gradient.within(np.ones(len(gradient.forces), dtype=bool))
    # a vector: on a meridian without the component around the axis, which is zero; else turned from
    # the model's frame into the case's
    if parameter == "remanence" and scene.problem.meridian:
        uniform_derivative = uniform_derivative[[0, 2]]
    elif parameter == "remanence":
        uniform_derivative = uniform_derivative @ rotation(scene.problem.azimuth)
    return [float(component) for component in uniform_derivative]


def _largest_density(surface: Surface, parameter: str) -> dict[str, Any]:
    """Return the largest norm of a field's gradient per area, and the undeformed place (3,) over R.

    They are the entries `most_per_area` and `at` of summary.json. `parameter` is that of the
    gradient, which has one or more fields of the surface.
    """
    columns = [surface.fields[name] for name in columns_of(parameter)]
    sizes = np.linalg.norm(np.column_stack(columns), axis=1)
    place = int(np.argmax(sizes))
    return {
        "most_per_area": float(sizes[place]),
        "at": [float(coordinate) for coordinate in surface.r0[place]],
    }


def _surface(scene: Scene, adjoint: Adjoint, fields: Mapping[str, FieldGradient]) -> Surface | None:
    """Return the whole deformed shell with the gradients per area as fields; collective.

    None on ranks other than 0. `fields` maps parameters to gradients.
    """
    model = scene.model
    gathering, densities = gatherer(model, scene.comm), dict[str, Array | None]()
    width = model.V.dofmap.bs  # components at a node: 2 on a meridian, else 3
    # gradients per area at the nodes on rank 0: a vector field, or a field for each column
    for parameter, gradient in fields.items():
        values = density(scene, gradient)
        if parameter == "remanence":
            vectors = values[:, [0, 2]] if width == 2 else values
            densities[parameter] = _at_nodes(scene, gathering, vectors)
            continue
        for i, name in enumerate(columns_of(parameter)):
            # the gatherer takes vectors: a number goes as the component along e3, the last one
            vectors = np.zeros((len(values), width))
            vectors[:, -1] = values[:, i]
            at_nodes = _at_nodes(scene, gathering, vectors)
            densities[name] = None if at_nodes is None else at_nodes[:, 2]
    # the deformed surface with these fields, completed to the whole shell
    deformed = gathering.gather(adjoint.state.u)
    if deformed is None:
        return None
    gathered_fields = {name: density for name, density in densities.items() if density is not None}
    surface = replace(deformed, fields=gathered_fields)
    if model.multiplicity > 1:
        assert not model.axisymmetric
        surface = completed_by_symmetry(surface, model.mirror)
    return rotated_surface(surface, scene.problem.azimuth)


def _at_nodes(scene: Scene, gathering: Gatherer, values: Array) -> Array | None:
    """Return vectors (n, 3) at the nodes of pictures on rank 0, None elsewhere; collective.

    `values` (nodes, 2 or 3) are the vectors at this rank's nodes of the model.
    """
    surface = gathering.gather(values.ravel()[: scene.model.system.size])
    return surface.u if surface else None
