"""The lowest instabilities of a path as results that have gradients."""

from collections.abc import Sequence

from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, adjoint_of_instability
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

FOLDS = {"knockdown": "pressure", "critical_field": "lambda_m"}  # result -> the amplitude of its fold
BESIDE = 1.15  # instabilities up to this multiple of the lowest are looked at
MOST = 5  # and at most so many


class Lost(RuntimeError):
    """The path of a case has no such result."""


def located(records: Sequence[Record], amplitude: str) -> list[Record]:
    """Where the path loses its stability in an amplitude."""
    there = [r for r in records if r.amplitude == amplitude and not r.branch]
    return [r for r in there if r.label == "fold" or (r.label == "bifurcation" and not r.point.negative_pivots)]


def load(record: Record, amplitude: str) -> float:
    """Its size."""
    return abs(record.point.state.mu[amplitude])


def instabilities(
    scene: Scene, records: Sequence[Record], amplitude: str, most: int = MOST
) -> list[tuple[str, Adjoint]]:
    """The instabilities of a path by name, the lowest first, and what their derivatives are contracted with.

    Raises
    ------
    Lost, FoldLost
        If there is none, or the lowest one has no gradient.
    """
    there = sorted(located(records, amplitude), key=lambda r: load(r, amplitude))
    found = list[tuple[str, Adjoint]]()
    for record in [r for r in there if load(r, amplitude) <= BESIDE * load(there[0], amplitude)][:most]:
        name = record.mode or record.label
        try:
            found.append((name, adjoint_of_instability(scene, record)))
        except CaseError as e:
            if not found:
                raise Lost(str(e)) from None
    if not found:
        raise Lost(f"the path has no instability in {amplitude}")
    return sorted(found, key=lambda each: abs(each[1].value))
