"""The field section in the model's frame."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.controls import read_vectors
from magshell_fenicsx.input.direction import Direction
from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.models.shell.controls import ByControls, Controls
from magshell_fenicsx.models.shell.parameters import Magnetisation
from magshell_fenicsx.models.shell.patterns import Components, Inside, Pattern, WithinRims, radial, tangential
from magshell_fenicsx.parts.magnetism.fields import MagneticSection, RemanentSection, layer_average
from magshell_fenicsx.parts.magnetism.sources.field import in_space, turns
from magshell_fenicsx.shape.sections import MeshSurface

Array = NDArray[np.float64]
SAME = 1e-9  # part of a direction outside a plane: rounding


def by_points(section: RemanentSection, turn: float = 0.0) -> ByControls:
    """A remanence by vectors at points, in a frame turned about e3 (rad).

    Raises
    ------
    CaseError
        If its file cannot be read.
    """
    places, vectors = read_vectors(section.path, "magnetic.remanent.file", section.files)
    assert section.filter
    return ByControls(Controls(places, section.filter), vectors, rotation(turn) if turn else None)


def magnetisation(
    magnetic: MagneticSection, case: Case, turn: float, within: Mapping[str, Inside], to: Sequence[Direction] = ()
) -> Magnetisation:
    """What is magnetised and how it is modelled, in a frame turned about e3 (rad).

    Parameters
    ----------
    within
        Of `Plan`.
    to
        Directions that the field turns to.
    """
    section, gradient = magnetic.remanent, magnetic.applied.gradient
    remanent: NDArray[np.float64] | Pattern
    if section.kind == "radial":
        remanent = radial
    elif section.kind == "tangential":
        remanent = tangential
    elif section.components:
        remanent = Components([formula(text) for text in section.components], rotation(turn) if turn else None)
    elif section.file:
        remanent = by_points(section, turn)
    elif section.layers:
        remanent = layer_average(section.layers, turn)
    elif section.patches and not isinstance(case.shell, MeshSurface):
        vectors = {name: direction.vector(turn) for name, direction in section.patches.items()}
        rest = vectors.pop("rest")
        rims = tuple((inside, vectors.get(name, rest)) for name, inside in within.items())
        remanent = WithinRims(rims, rest) if vectors else rest
    else:
        remanent = section.vector(turn)
    known, driven = in_space(case, turn)
    basis = [magnetic.applied.vector(turn)]
    for direction in () if known else to:
        away = direction.vector(turn) - np.sum([(direction.vector(turn) @ e) * e for e in basis], axis=0)
        if np.linalg.norm(away) > SAME:
            basis.append(away / np.linalg.norm(away))
    applied, *across = (magnetic.applied.uniform * e for e in basis)
    patches = None
    if section.patches and isinstance(case.shell, MeshSurface):
        patches = {name: direction.vector(turn) for name, direction in section.patches.items()}
    Q = rotation(turn)
    layers = tuple((layer.fraction, layer.vector(turn)) for layer in section.layers or [])
    G = Q @ np.array(gradient) @ Q.T if gradient and not known else None
    return Magnetisation(
        remanent,
        applied,
        magnetic.energy,
        G,
        tuple(across),
        patches,
        layers,
        magnetic.remanence,
        known,
        tuple(basis),
        driven,
        turns(case, turn),
    )
