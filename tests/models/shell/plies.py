"""Laminates for tests."""

from typing import Any

from magshell_fenicsx.models.shell.laminate import Laminate
from magshell_fenicsx.parts.laminate import LaminateSection


def ply(
    angle: float,
    E1: float,
    fraction: float = 0.0,
    *,
    E2: float = 1.0,
    nu12: float = 0.25,
    G12: float = 0.6,
) -> Any:
    """One of a case; by default it has the rest of the thickness."""
    return {
        "angle": float(angle),
        "E1": E1,
        "E2": E2,
        "nu12": nu12,
        "G12": G12,
        "fraction": fraction,
    }


def section(*plies: Any, **keys: Any) -> LaminateSection:
    """Of plies, of which those without a fraction share the rest."""
    rest = 1 - sum(each["fraction"] for each in plies)
    left = sum(not each["fraction"] for each in plies)
    return LaminateSection(
        plies=[each | {"fraction": each["fraction"] or rest / left} for each in plies], **keys
    )


def laminate(*plies: Any, **keys: Any) -> Laminate:
    """That of `section` over E = 1, of a strip."""
    found = section(*plies, **keys)
    return Laminate(found.matrices(1.0), found.direction("strip"))
