"""Fields as colours: values, limits, captions with units; what is zero or cannot be said is named,
not drawn.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import SHELL, Surface
from magshell_fenicsx.output.pictures.scales import NEAR, SIGNED, from_zero

Array = NDArray[np.float64]
MAGNITUDE = "viridis"
STRAINS = {"E_1": "larger principal strain $E_1$", "E_2": "smaller principal strain $E_2$"}
MOMENTS = {"M_1": "larger principal moment $M_1R/D$", "M_2": "smaller principal moment $M_2R/D$"}
STRETCHES = {
    "stretch_1": r"larger principal stretch $\lambda_1$",
    "stretch_2": r"smaller principal stretch $\lambda_2$",
    "stretch_3": r"stretch of the thickness $\lambda_3$",
    "sigma_1": r"true stress $\sigma_1/E$",
    "sigma_2": r"true stress $\sigma_2/E$",
}
LOADS = {  # caption with its unit, name in words
    "couple": (
        r"couple $|F\hat B^\mathrm{r} \times \hat B^\mathrm{a}|/(hE\lambda_\mathrm{m})$",
        "couple of the remanence in the field",
    ),
    "p_mag": (r"magnetic pressure $p_\mathrm{mag}/(E\lambda_\mathrm{m})$", "magnetic pressure"),
    "f_mag": (r"in-plane force $|f_\mathrm{mag}|/(E\lambda_\mathrm{m})$", "in-plane force"),
    "k": (r"rotational springs $k/(hE\lambda_\mathrm{m})$", "rotational springs"),
    "tau": (r"torque of gradients $|\tau(u)|/(hE\lambda_\mathrm{m})$", "torque of gradients"),
}
SCALARS = {  # of the interactive report, in HTML; of vectors the length
    "w_over_h": "inward displacement w/h",
    "E_1": "larger membrane strain E<sub>1</sub>",
    "E_2": "smaller membrane strain E<sub>2</sub>",
    "M_1": "larger bending moment M<sub>1</sub>R/D",
    "M_2": "smaller bending moment M<sub>2</sub>R/D",
    "stretch_1": "larger stretch λ<sub>1</sub>",
    "stretch_2": "smaller stretch λ<sub>2</sub>",
    "stretch_3": "stretch of the thickness λ<sub>3</sub>",
    "sigma_1": "true stress σ<sub>1</sub>/E",
    "sigma_2": "true stress σ<sub>2</sub>/E",
    "couple": "couple |B<sup>r</sup>×B<sup>a</sup>|/(hEλ<sub>m</sub>)",
    "p_mag": "magnetic pressure/(Eλ<sub>m</sub>)",
    "f_mag": "magnetic in-plane force/(Eλ<sub>m</sub>)",
    "k": "rotational springs/(hEλ<sub>m</sub>)",
    "tau": "torque of gradients/(hEλ<sub>m</sub>)",
    "gap_over_h": "gap/h",
    "contact_pressure": "contact pressure pR/(Eh)",
    "w0_over_h": "imperfections w<sub>0</sub>/h",
    SHELL: "shell",
}
WITH_SIGN = {
    "w_over_h",
    *STRAINS,
    *MOMENTS,
    "sigma_1",
    "sigma_2",
    "p_mag",
    "k",
    "contact_pressure",
    "w0_over_h",
}
ZERO = 1e-9  # loads are of the order of one or of h: what is smaller comes from rounding
ROUNDING = {"E_1": 1e-13, "M_1": 1e-8}  # smaller values are drawn as zero
LEAST_JUMP = 0.01  # per cent
NOISE = 20.0  # colour limit over the difference between fields of cells and the smooth ones
NONE = 0.01  # of the larger of two fields: what is smaller is zero
UNRESOLVED, SLIGHT = (
    0.05,
    0.02,
)  # differences between cells, and strains over those of bending, that are not drawn
DETAIL, AROUND = (
    0.15,
    2.0,
)  # of a contact: its largest size over the shell's to be drawn alone; its surroundings
FEW = 12  # cells that carry a pressure whose distribution is not resolved
EVERYWHERE, PEAK = 0.997, 1.5  # colour limit: PEAK times this quantile of the area


@dataclass(frozen=True)
class Coloured:
    """Values (n,) at the nodes with their limits, a colour map and the caption of its bar."""

    name: str
    values: Array
    limits: tuple[float, float]
    colours: str
    caption: str


def shell(surface: Surface, h: float) -> list[Coloured]:
    """w/h, white at zero."""
    w = np.asarray(surface.w / h, np.float64)
    limits = from_zero(float(w.min()), float(w.max()))
    return [Coloured("w_over_h", w, limits, SIGNED, "inward normal displacement $w/h$")]


def strains(surface: Surface, h: float) -> tuple[list[Coloured], str]:
    """The principal strains, and a sentence on them; none where they are those of the mesh."""
    if bent_alone(surface, h):
        return [], ""
    shown, said = _principal(surface, STRAINS, surface.strain_jump)
    return shown, " ".join([*said, jump_said(surface.strain_jump, "strains")]) if shown else ""


def moments(surface: Surface, h: float) -> tuple[list[Coloured], str]:
    """The principal moments, and a sentence on them, and on strains that are not drawn."""
    shown, said = _principal(surface, MOMENTS, surface.jump)
    if shown:
        said.append(jump_said(surface.jump, "moments"))
    return shown, " ".join([*said, bent_alone(surface, h)]) if shown else ""


def bent_alone(surface: Surface, h: float) -> str:
    """That strains are not drawn, where they are small beside those of bending and differ from cell
    to cell.
    """
    if (
        not {*STRAINS, *MOMENTS} <= surface.fields.keys()
        or (surface.strain_jump or 0.0) < UNRESOLVED
    ):
        return ""
    largest, bending = (
        max(float(np.abs(surface.fields[name]).max()) for name in names)
        for names in (STRAINS, MOMENTS)
    )
    bending *= h / 2
    if not 0 < largest < SLIGHT * bending:
        return ""
    times = (
        f"{float(f'{bending / largest:.1g}'):.0f}"
        if largest > 1e-4 * bending
        else "more than 10 000"
    )
    return (
        f"Strains of the mid-surface are not drawn: those of bending are {times} times larger, "
        f"and the former differ from cell to cell by {100 * (surface.strain_jump or 0.0):.2g} % (rms)."
    )


def stretches(surface: Surface) -> list[Coloured]:
    """Stretches and true stresses of rubber; stresses are white at zero.

    Shells of another law beside it have none.
    """
    coloured = []
    for name, said in STRETCHES.items():
        if (values := surface.fields.get(name)) is not None:
            low, high, signed = (
                float(np.nanmin(values)),
                float(np.nanmax(values)),
                name.startswith("sigma"),
            )
            limits = (
                from_zero(low, max(high, ROUNDING["E_1"]))
                if signed
                else (low, max(high, low + 1e-9))
            )
            coloured.append(Coloured(name, values, limits, SIGNED if signed else MAGNITUDE, said))
    return coloured


def jump_said(jump: float | None, what: str) -> str:
    """How far the strains or moments of the cells are from the smooth field that is drawn."""
    if jump is None:
        return ""
    rms = 100 * jump
    far = f"by {rms:.2g} %" if rms >= LEAST_JUMP else f"by less than {LEAST_JUMP:g} %"
    return f"Smoothed across cells, whose own {what} differ from what is drawn {far} (rms)."


def _largest(surface: Surface, names: Iterable[str]) -> float:
    return max(float(np.abs(surface.fields[name]).max()) for name in names)


def _principal(
    surface: Surface, captions: dict[str, str], jump: float | None
) -> tuple[list[Coloured], list[str]]:
    """Two fields with the same colours, white at zero, so that rounding of a constant field is
    invisible.

    One that is zero beside the other, or no larger than what the mesh leaves of both, is named, not
    drawn.
    """
    if not captions.keys() <= surface.fields.keys():
        return [], []
    first, second = captions
    limit = max(_limit(surface, first, second), _noise(surface, first, second, jump or 0.0))
    shown, said = list[Coloured](), list[str]()
    sizes = {name: float(np.abs(surface.fields[name]).max()) for name in captions}
    for name, caption in captions.items():
        values = surface.fields[name]
        if sizes[name] < NONE * max(sizes.values()):
            said.append(f"The {caption.partition(' $')[0]} is zero everywhere.")
            continue
        if float(np.sqrt((values**2).mean())) < _noise(surface, first, second, jump or 0.0) / NOISE:
            said.append(f"The {caption.partition(' $')[0]} is zero but for the mesh.")
            continue
        below, above = from_zero(float(values.min()), float(values.max()), NONE)
        limits = (-limit if below < 0 else 0.0, limit if above > 0 else 0.0)
        if max(sizes.values()) < ROUNDING[first]:
            limits = -limit, limit
        shown.append(Coloured(name, values, limits, SIGNED, caption))
    return shown, said


def _noise(surface: Surface, first: str, second: str, jump: float) -> float:
    """The colour limit far above that by which the fields of cells differ: what is zero but for the
    mesh is pale.
    """
    sizes = surface.fields[first] ** 2 + surface.fields[second] ** 2
    return NOISE * jump * float(np.sqrt(sizes.mean()))


def _limit(surface: Surface, first: str, second: str) -> float:
    """The colour limit of two fields: their largest magnitude, without peaks of small area such as
    at a point load.
    """
    size = np.maximum(np.abs(surface.fields[first]), np.abs(surface.fields[second]))
    if (largest := float(size.max())) < ROUNDING[first]:
        return 1.0
    in_cells = size[surface.cells].mean(axis=1)
    a, b, c = np.moveaxis(surface.r0[surface.cells[:, :3]], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    order = np.argsort(in_cells)
    most = in_cells[order][np.searchsorted(np.cumsum(area[order]), EVERYWHERE * area.sum())]
    return float(min(largest, max(PEAK * most, ROUNDING[first])))


def couple(surface: Surface) -> Array | None:
    """The moment (n, 3) of the field on the carried remanence per area, over h E λ_m; None without
    a field.

    λ_m is the largest length of the applied field, so that of a uniform field it is the product of
    unit vectors.
    """
    fields = surface.fields
    if not {"Br", "Ba"} <= fields.keys():
        return None
    largest = float(np.nan_to_num(np.linalg.norm(fields["Ba"], axis=1)).max())
    return (
        np.asarray(np.cross(fields["Br"], fields["Ba"]) / largest, np.float64) if largest else None
    )


def loads(surface: Surface, h: float) -> tuple[list[Coloured], str]:
    """The magnetic loads that are not zero everywhere, and a sentence on those left out."""
    fields = surface.fields
    c = couple(surface)
    if c is None:
        return [], ""
    shown, zero, unknown = [], [], []
    for name, (caption, words) in LOADS.items():
        values = c if name == "couple" else fields.get(name)
        if values is None:
            unknown.append(words)
            continue
        signed = values.ndim == 1
        values = np.nan_to_num(values if signed else np.linalg.norm(values, axis=1))
        largest = float(np.abs(values).max())
        if largest < ZERO:
            zero.append(words)
            continue
        limits = from_zero(float(values.min()), float(values.max())) if signed else (0.0, largest)
        shown.append(Coloured(name, values, limits, SIGNED if signed else MAGNITUDE, caption))
    said = [f"Zero everywhere: {', '.join(zero)}."] if zero else []
    said += [f"Not defined for this remanence or field: {', '.join(unknown)}."] if unknown else []
    return shown, " ".join(said)


def contact(surface: Surface) -> list[Coloured]:
    """The gap and the pressure of bodies; none where nothing touches or the mesh resolves no
    pressure.
    """
    if not {"gap_over_h", "contact_pressure"} <= surface.fields.keys():
        return []
    gap, pressure = surface.fields["gap_over_h"], surface.fields["contact_pressure"]
    layers = [Coloured("gap_over_h", gap, (0.0, 1.0), NEAR, "gap$/h$")]
    if (most := float(np.max(pressure, where=np.isfinite(pressure), initial=0.0))) > 0:
        caption = r"contact pressure $pR/(Eh)$"
        layers.append(Coloured("contact_pressure", pressure, (0.0, most), SIGNED, caption))
    return layers


def pressure_said(surface: Surface) -> str:
    """Return the note under the contact pressure: nothing touches, no cell resolves it, or few
    cells carry it.
    """
    pressure = surface.fields["contact_pressure"]
    unresolved, most = np.isnan(pressure).any(), np.nan_to_num(pressure).max()
    if not most:
        narrow = "The contact is narrower than a cell of the mesh, so that no pressure is drawn."
        return narrow if unresolved else "Nothing touches."
    if unresolved:
        return "Where the contact is narrower than a cell of the mesh, no pressure is drawn."
    number = int((pressure[surface.cells] > 0).all(axis=1).sum())
    return f"The pressure is a mean over each cell; {number} carry it." if 0 < number < FEW else ""


def contact_region(surface: Surface) -> Array | None:
    """Places (8, 3) around the contact, if it is so small that a picture of the whole shell would
    not show it.
    """
    r = surface.r0 + surface.u
    touching = r[(surface.fields["contact_pressure"] > 0) | (surface.fields["gap_over_h"] < 1)]
    if not len(touching):
        return None
    low, high = touching.min(axis=0), touching.max(axis=0)
    size = float((high - low).max())
    if size > DETAIL * float(np.ptp(r, axis=0).max()):
        return None
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    return np.asarray((low + high) / 2 + AROUND * size * corners)
