"""Description of a model in words: what is included, and what is left out.

An account is what one part of a case has to say. The meridian, a half or a sector is the part of
the shell that is modelled. A rim is the circle where a dimple ends and its curvature jumps, along
which a mesh may have edges. k_d is the critical pressure.
"""

from collections import Counter
from math import degrees

from magshell_fenicsx.mesh.mirror import Mirror, Sector, plane_text
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.imperfections.symmetry import MAX_RIMS
from magshell_fenicsx.parts.laminate import laminate_account
from magshell_fenicsx.parts.laws.law_section import LawSection, law_account
from magshell_fenicsx.parts.laws.rubber_material import laws_of
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.registered import OBSERVABLES, PART_CLASSES
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.problem.problem import SolidBody, solid_body_of

MAX_LISTED_IMPERFECTIONS = 6  # of more only the kinds are told


def describe_model(
    context: Context, loads: Loads, model: str, mirror: Mirror | None, rims: int
) -> tuple[list[str], list[str]]:
    """Return phrases for what a model includes, and phrases for what it leaves out.

    Parameters
    ----------
    model
        "meridian", "half shell", ...
    mirror
        Symmetry plane of a half, or the sector; None if all is modelled.
    rims
        Number of different rims of dimples besides the pole's.
    """
    # the law, and what each part of the case has to say
    body = solid_body_of(context)
    included = [model, _body_text(body, context.shell.law_section) if body else _law_text(context)]
    left_out = list[str]()
    for observables in OBSERVABLES:
        part_account = observables.account(context, loads)
        included += part_account.included
        left_out += part_account.left_out
    if context.sections.get("imperfections"):
        included.append(_imperfections_text(context, rims))
    # each amplitude once, by its last step
    for step in context.last_steps.values():
        if text := step.load.account(context.at_step(step)):
            included.append(text)
    # sections of the case that may be absent
    for key, part_class in PART_CLASSES.items():
        if part := context.sections.get(key):
            included.append(part.account(context))
        elif part_class.absent:
            left_out.append(part_class.absent)
    return included, [*left_out, *_left_out_by_symmetry(loads, model, mirror)]


def _left_out_by_symmetry(loads: Loads, model: str, mirror: Mirror | None) -> list[str]:
    """Return phrases for what a meridian, a half or a sector leaves out."""
    left_out = list[str]()
    if model == "meridian":
        contact_words = ""
        if loads.pairs:
            contact_words = "; where shells touch, not those that come and go between two"
        left_out.append(f"waves around the axis (they are looked for at each point{contact_words})")
    if isinstance(mirror, Sector):
        first_azimuth = degrees(mirror.azimuth) + 0.0  # no -0
        left_out.append(
            f"the other {mirror.copies - 1} sectors: mirror planes through e3 at azimuths "
            f"{first_azimuth:.5g} and {first_azimuth + degrees(mirror.angle):.5g} degrees "
            "(modes that they exclude are counted, not located)"
        )
    elif mirror:
        plane = plane_text(mirror)
        if mirror.through_e3:
            plane = f"through e3 at azimuth {degrees(mirror.azimuth) + 0.0:g} degrees"
        left_out.append(
            f"the other half: mirror plane {plane} "
            "(modes antisymmetric to it are looked for along the path)"
        )
    return left_out


def _imperfections_text(context: Context, rims: int) -> str:
    """Return a phrase about each of a few imperfections, or about the number of each kind.

    `rims` is the number of different rims of dimples, of which a mesh can follow `MAX_RIMS`.
    """
    sections = context.sections["imperfections"].values()
    words = [section.account() for section in sections]
    if len(words) > MAX_LISTED_IMPERFECTIONS:
        kinds = Counter(section.kind for section in sections)
        words = [f"{count} of kind {kind}" for kind, count in kinds.items()]
    warning = ""
    is_mesh_file = isinstance(context.shell, MeshSurface)
    lacks_rims = is_mesh_file or rims > MAX_RIMS
    if lacks_rims and any(section.patch for section in sections):
        reason = "of a mesh file" if is_mesh_file else f"of more than {MAX_RIMS}"
        warning = f"; elements lie across the rims of dimples, {reason}: k_d is then less exact"
    return f"imperfections: {', '.join(words)}{warning}"


def _law_text(context: Context) -> str:
    """Return a phrase about the law of a shell, or the laws of several."""
    laminate, laws = context.shell.laminate, laws_of(context)
    if {*laws} - {context.shell.law}:
        return f"membrane and bending energy, each of its own law: {', '.join(laws)}"
    if laminate:
        return laminate_account(laminate, context.shell)
    return law_account(context.shell.law_section)


def _body_text(body: SolidBody, law: LawSection) -> str:
    """Return a phrase about the law and the elements of a solid, whose shell has a law."""
    assert law.solid_law
    material, count = body.material, len(body.layer_bounds) - 1
    ratio = material.bulk / material.shear
    small_strains = f"E = {material.youngs_modulus:.5g}, nu = {material.nu:.5g} for small strains"
    numbers_text = law.solid_law.numbers_text
    energy_text = f"{law.solid_law.title} energy{', ' * bool(numbers_text)}{numbers_text}"
    return (
        f"{energy_text}, kappa/mu = {ratio:.5g} ({small_strains}), {count} layer{'s' * (count > 1)}"
    )
