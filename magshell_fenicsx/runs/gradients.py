"""After a run: derivatives of its results by numbers and fields."""

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
from magshell_fenicsx.output.fields.modes import columns_of, gradient_file
from magshell_fenicsx.output.fields.surface import Surface, turned, whole
from magshell_fenicsx.output.fields.vtu import About, vtu_content
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.follow import BEYOND
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint
from magshell_fenicsx.simulate.gradients.fields import density
from magshell_fenicsx.simulate.gradients.gradient import Gradient, derivative
from magshell_fenicsx.simulate.gradients.instabilities import (
    FOLDS,
    Lost,
    instabilities,
    refuse_moving,
)
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end, refuse_no_result
from magshell_fenicsx.simulate.numbers import refuse_unknown_parameters
from magshell_fenicsx.simulate.scene import Scene

Say = Callable[[str], None]
ROUNDING = 1e-10
Array = NDArray[np.float64]


def refuse_unknown(scene: Scene) -> None:
    """See before a run that its gradients can be asked for.

    Raises
    ------
    CaseError
        If a result or a parameter is none of this case.
    """
    section, start = scene.problem.gradients, scene.unloaded()
    if section is None:
        return
    refuse_no_result(scene, section.of, "gradients.of")
    refuse_unknown_parameters(scene.problem.context, section.by, start)


def gradients_after(result: Result, folder: Path | None, say: Say) -> None:
    """Keep the numbers, and with a folder write fields/gradients_*.vtu; collective.

    Raises
    ------
    DiskError
        On every rank, if something cannot be written.
    """
    scene, section = result.scene, result.scene.problem.gradients
    for of in section.of if section else []:
        assert section
        try:
            kind, adjoint = _adjoint(result, of)
        except (CaseError, FoldLost, Lost) as e:
            say(f"warning: no gradient of {of}: {e}")
            continue
        slopes = _slopes(adjoint, of, section.by, say)
        if not slopes:
            continue
        fields = {by: each for by, each in slopes.items() if isinstance(each, FieldGradient)}
        numbers = {
            by: float(each) for by, each in slopes.items() if not isinstance(each, FieldGradient)
        }
        scene = adjoint.scene  # that of the end, which may be of another model
        told: dict[str, dict[str, Any]] = {
            by: {"alike": _alike(scene, by, each)} for by, each in fields.items()
        }
        if fields:
            drawn = _surface(scene, adjoint, fields)
            for by, most in scene.comm.bcast(
                drawn and {by: _most(drawn, by) for by in fields}
            ).items():
                told[by] |= most
            if folder:
                by_first(scene.comm, partial(_write, gradient_file(folder, of), drawn, scene))
        result.gradients[of] = {
            "value": adjoint.shown,
            "kind": kind,
            "numbers": numbers,
            "fields": told,
        }
        for by, v in told.items():
            alike, place = _words(v["alike"], v["most_per_area"], 6), _words(v["at"], 1.0, 3)
            say(
                f"d {of}/d {by}: {alike} for a change that is the same everywhere, most per area at ({place})"
            )
        for by, slope in numbers.items():
            say(f"d {of}/d {by}: {slope:.6g}")


def _slopes(adjoint: Adjoint, of: str, names: Sequence[str], say: Say) -> dict[str, Gradient]:
    """The derivatives of a result by all that it has one by; the others are named; collective."""
    slopes = dict[str, Gradient]()
    for by in names:
        try:
            slopes[by] = derivative(adjoint, by)
        except (CaseError, FoldLost, Lost) as e:
            say(f"warning: no gradient of {of} by {by}: {e}")
    return slopes


def _words(values: Sequence[float], size: float, digits: int) -> str:
    """Numbers beside a size: what is but rounding of it is 0."""
    return ", ".join(f"{x if abs(x) > ROUNDING * size else 0.0:.{digits}g}" for x in values)


def _write(file: Path, drawn: Surface | None, scene: Scene) -> None:
    assert drawn
    write_whole(
        file, vtu_content(drawn, About(scene.problem.material.h, scene.problem.material.nu))
    )


def _adjoint(result: Result, of: str) -> tuple[str, Adjoint]:
    """What the derivatives of a result are contracted with, and of which kind it is."""
    scene, history = result.scene, result.walked
    if of in FOLDS:
        return instabilities(scene, history.located, of, 1, history.begins)[0]
    beyond = next((remark for remark in result.remarks if remark.startswith(BEYOND)), None)
    if result.stopped or beyond or history.end is None:
        raise Lost(result.stopped or beyond or "the path has no end")
    refuse_moving(scene, history.end, of)
    return adjoint_at_end(scene, history, of)


def _alike(scene: Scene, by: str, gradient: FieldGradient) -> list[float]:
    """By a field that changes alike everywhere, of vectors in the case's frame; of a meridian along
    e_rho, e_z.
    """
    total = gradient.within(np.ones(len(gradient.forces), dtype=bool))
    if by == "remanence":
        total = total[[0, 2]] if scene.problem.meridian else total @ rotation(scene.problem.azimuth)
    return [float(v) for v in total]


def _most(drawn: Surface, by: str) -> dict[str, Any]:
    """The largest size per area of a field, and where."""
    sizes = np.linalg.norm(np.column_stack([drawn.fields[name] for name in columns_of(by)]), axis=1)
    place = int(np.argmax(sizes))
    return {"most_per_area": float(sizes[place]), "at": [float(x) for x in drawn.r0[place]]}


def _surface(scene: Scene, adjoint: Adjoint, fields: Mapping[str, FieldGradient]) -> Surface | None:
    """The whole deformed shell with the densities as its fields, on rank 0; collective."""
    gathering, model, drawn = (
        gatherer(scene.model, scene.comm),
        scene.model,
        dict[str, Array | None](),
    )
    width = model.V.dofmap.bs
    for by, each in fields.items():
        values = density(scene, each)
        if by == "remanence":
            drawn[by] = _at_nodes(scene, gathering, values[:, [0, 2]] if width == 2 else values)
            continue
        for i, name in enumerate(columns_of(by)):
            vectors = np.zeros((len(values), width))
            vectors[:, -1] = values[:, i]
            along = _at_nodes(scene, gathering, vectors)
            drawn[name] = None if along is None else along[:, 2]
    base = gathering.gather(adjoint.state.u)
    if base is None:
        return None
    surface = replace(base, fields={name: v for name, v in drawn.items() if v is not None})
    if model.multiplicity > 1:
        assert not model.axisymmetric
        surface = whole(surface, model.mirror)
    return turned(surface, scene.problem.azimuth)


def _at_nodes(scene: Scene, gathering: Gatherer, values: Array) -> Array | None:
    """Vectors at this rank's nodes as those at all nodes that are drawn, on rank 0; collective."""
    gathered = gathering.gather(values.ravel()[: scene.model.system.size])
    return gathered.u if gathered else None
