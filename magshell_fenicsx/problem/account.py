"""What a model has and what is left out, in words."""

from collections import Counter
from math import degrees

from magshell_fenicsx.mesh.mirror import Mirror, Sector, plane_text
from magshell_fenicsx.parts.imperfections.symmetry import MOST_RIMS
from magshell_fenicsx.parts.laminate import laminate_account
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.registered import PARTS, accounts, parts_of
from magshell_fenicsx.parts.rubber import law_account, laws_of
from magshell_fenicsx.problem.problem import Body, body_of
from magshell_fenicsx.shape.sections import MeshSurface

SHOWN = 6  # of many imperfections


def account(
    context: Context, loads: Loads, model: str, mirror: Mirror | None, rims: int
) -> tuple[list[str], list[str]]:
    """What is included and what is left out.

    Parameters
    ----------
    model
        "meridian", "half shell", ...
    mirror
        Plane of a half.
    rims
        Number of different rims beside the pole.
    """
    body = body_of(context)
    included = [model, _elastic(body) if body else _of_shell(context)]
    left_out = list[str]()
    for room in accounts(context, loads):
        included += room.included
        left_out += room.left_out
    if context.sections.get("imperfections"):
        included.append(_imperfections(context, rims))
    for step in {step.name: step for step in context.steps}.values():
        included += [said] if (said := step.load.account(step, context)) else []
    parts = parts_of(context)
    for key, part in PARTS.items():
        if key in parts:
            included.append(parts[key].account(context.scales))
        else:
            left_out.append(part.absent)
    if model == "meridian":
        between = (
            "; where shells touch, not those that come and go between two" if loads.pairs else ""
        )
        left_out.append(f"waves around the axis (they are looked for at each point{between})")
    if isinstance(mirror, Sector):
        begin = degrees(mirror.azimuth) + 0.0
        left_out.append(
            f"the other {mirror.copies - 1} sectors: mirror planes through e3 at azimuths {begin:.5g} and "
            f"{begin + degrees(mirror.angle):.5g} degrees (modes that they exclude are counted, not located)"
        )
    elif mirror:
        plane = (
            f"through e3 at azimuth {degrees(mirror.azimuth) + 0.0:g} degrees"
            if mirror.through_e3
            else plane_text(mirror)
        )
        left_out.append(
            f"the other half: mirror plane {plane} (modes antisymmetric to it are looked for along the path)"
        )
    return included, left_out


def _imperfections(context: Context, rims: int) -> str:
    """All of a few; of many how many there are of each kind."""
    sections = context.sections["imperfections"].values()
    words = [section.account() for section in sections]
    if len(words) > SHOWN:
        kinds = Counter(section.kind for section in sections)
        words = [f"{count} of kind {kind}" for kind, count in kinds.items()]
    beside = ""
    read = isinstance(context.shell, MeshSurface)
    if any(section.patch for section in sections) and (read or rims > MOST_RIMS):
        why = "of a mesh file" if read else f"of more than {MOST_RIMS}"
        beside = f"; elements lie across the rims of dimples, {why}: k_d is then less exact"
    return f"imperfections: {', '.join(words)}{beside}"


def _of_shell(context: Context) -> str:
    laminate, laws = context.shell.laminate, laws_of(context)
    if {*laws} - {context.shell.law}:
        return f"membrane and bending energy, each of its own law: {', '.join(laws)}"
    return (
        laminate_account(laminate, context.shell) if laminate else law_account(context.shell.rubber)
    )


def _elastic(body: Body) -> str:
    material, count = body.material, len(body.layers) - 1
    ratio = material.bulk / material.shear
    small_strains = f"E = {material.youngs_modulus:.5g}, nu = {material.nu:.5g} for small strains"
    law, share = "neo-Hookean energy", material.share
    if share:
        law = f"Mooney-Rivlin energy, C01/C10 = {share / (1 - share):.5g}"
    return f"{law}, kappa/mu = {ratio:.5g} ({small_strains}), {count} layer{'s' * (count > 1)}"
