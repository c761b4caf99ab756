"""Fields as colours: values, limits, captions with units.

A field that is zero or unknown is named in a note and not drawn. Fields are chosen, and their
limits found, as numbers over their units; `in_units` gives them the units of a case.

Input: a `Surface`, the deformed shell with fields at its nodes. Output: for each panel of a picture
a `ColouredField`, and a note for its foot. Limits are the values at the ends of the colours.

E_1, E_2, M_1, M_2 are principal values of membrane strain and bending moment. The jump of strains
or moments is the rms of the difference between the cells' own values and the smooth field that is
drawn, over the rms of the field; it measures the noise of the mesh. Br and Ba are remanence and
applied magnetic field, h and R thickness and reference length, E is Young's modulus, D the bending
stiffness.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan, nan

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.contact_peak import ContactPeak
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.scales import DISTANCE, SIGNED, from_zero, round_limits
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.fields import FIELDS, in_case_unit
from magshell_fenicsx.quantities.quantity import NO_UNITS, CaseSizes, Unit, with_prefix
from magshell_fenicsx.quantities.stresses import MEMBRANE_FORCE

Array = NDArray[np.float64]
MAGNITUDE = "viridis"
STRAINS = ("E_1", "E_2")  # names of fields, the larger principal value first
MOMENTS = ("M_1", "M_2")
STRETCHES = ("stretch_1", "stretch_2", "stretch_3", "sigma_1", "sigma_2")
LOADS = {  # in notes
    "couple": "couple of the remanence in the field",
    **{name: FIELDS[name].words for name in ("p_mag", "f_mag", "k", "tau")},
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
ZERO_LOAD = 1e-9  # loads are of the order of one or of h: smaller ones come from rounding
ZERO_STRESS = {"E_1": 1e-13, "M_1": 1e-8}  # smaller values are drawn as zero
MIN_STRETCH_RANGE = 1e-9  # of the colours
MIN_JUMP = 0.01  # per cent, that is said
LIMIT_OVER_NOISE = 20.0  # colour limit over the difference of fields of cells from smooth ones
ZERO_FRACTION = 0.01  # of the larger of two fields: a smaller one is zero
UNRESOLVED_JUMP = 0.05  # strains that differ more from cell to cell may be left out
SMALL_STRAIN = 0.02  # strains over those of bending that may be left out
UNKNOWN_RATIO = 1e-4  # strains over those of bending: for smaller ones the ratio is not said
CONTACT_FORCE = Unit("E h R", "N", size=lambda g: g.E * g.h * g.R)
MAX_CONTACT_SIZE = 0.15  # of a contact that is drawn alone, over the shell's extent
CONTACT_MARGIN = 2.0  # size of the region around a contact over that of the contact
MINOR_PRESSURE = 0.05  # over that of a contact narrower than a cell: less is not drawn beside it
MIN_PRESSED_CELLS = 12  # that resolve the distribution of a pressure
# colour limit: PEAK times this quantile of the area
AREA_QUANTILE, PEAK = 0.997, 1.5


@dataclass(frozen=True)
class ColouredField:
    """Field of a picture as colours.

    Attributes
    ----------
    name
        Name of the field in the surface; empty for a grey shell.
    values
        (n,) at the nodes.
    limits
        Values at the ends of the colours.
    colours
        Name of the colour map: `SIGNED`, `DISTANCE` or one of matplotlib's; empty for grey.
    caption
        Caption of the colour bar.
    size
        Size of a 1 of the field in the unit of `values` and `limits`.
    """

    name: str
    values: Array
    limits: tuple[float, float]
    colours: str
    caption: str
    size: float = 1.0

    def limits_within(self, ranges: Mapping[str, Sequence[float]]) -> tuple[float, float]:
        """Return the limits, or those that the section `output` of a case gives for the field.

        `ranges` maps the name of a field to limits over its own unit.
        """
        if self.name not in ranges:
            return self.limits
        return _scaled(ranges[self.name], self.size)


def _scaled(limits: Sequence[float], size: float) -> tuple[float, float]:
    """Return limits in another unit, in which a 1 has a size that may be negative."""
    low, high = sorted(size * limit for limit in limits)
    return low, high


def field_caption(name: str) -> str:
    """Return the caption of a field over its unit, in TeX.

    Examples
    --------
    >>> field_caption("w_over_h"), field_caption("gap_over_h")
    ('inward normal displacement $w/h$', 'gap$/h$')
    """
    field = FIELDS[name]
    return f"{field.words} {field.latex}" if field.symbol else f"{field.words}$/{field.unit}$"


def in_units(field: ColouredField, sizes: CaseSizes) -> ColouredField:
    """Return a coloured field in the unit of a case; unchanged if the case has no such unit.

    `sizes` are those of the case at the state that is shown.
    """
    if field.name not in FIELDS:  # a grey shell
        return field
    quantity = FIELDS[field.name]
    in_unit, size = in_case_unit(quantity, sizes, max(map(abs, field.limits)))
    if in_unit is quantity:
        return field
    return replace(
        field,
        values=size * field.values,
        limits=_scaled(field.limits, size),
        caption=in_unit.label,
        size=size,
    )


def field_at(row: Row) -> float:
    """Return the field λ_m at the point of a row of path.csv; nan of one that has turned.

    The magnetic loads are those of a field in its first direction.
    """
    return nan if row["field_angle"] else float(row["lambda_m"])


def sizes_at(sizes: CaseSizes, surface: Surface, lambda_m: float) -> CaseSizes:
    """Return the sizes of a case with the magnetic field λ_m at the state of a surface."""
    if "Ba" not in surface.fields:
        return sizes
    largest = float(np.nan_to_num(np.linalg.norm(surface.fields["Ba"], axis=1)).max())
    return replace(sizes, lambda_m=lambda_m, largest_field=largest)


def shell(surface: Surface, h: float) -> list[ColouredField]:
    """Return the inward normal displacement w/h, white at zero."""
    w = np.asarray(surface.w / h, np.float64)
    limits = from_zero(float(w.min()), float(w.max()))
    return [ColouredField("w_over_h", w, limits, SIGNED, field_caption("w_over_h"))]


def strains(surface: Surface, h: float) -> tuple[list[ColouredField], str]:
    """Return the principal strains as coloured fields, and a note.

    Both are empty where the strains are noise of the mesh. `h` is the thickness over R.
    """
    if unresolved_strains_note(surface, h):
        return [], ""
    fields, notes = _principal(surface, STRAINS, surface.strain_jump)
    if not fields:
        return [], ""
    return fields, " ".join([*notes, jump_note(surface.strain_jump, "strains")])


def moments(surface: Surface, h: float) -> tuple[list[ColouredField], str]:
    """Return the principal moments as coloured fields, and a note, also on strains not drawn.

    `h` is the thickness over R.
    """
    fields, notes = _principal(surface, MOMENTS, surface.jump)
    if not fields:
        return [], ""
    notes += [jump_note(surface.jump, "moments"), unresolved_strains_note(surface, h)]
    return fields, " ".join(notes)


def unresolved_strains_note(surface: Surface, h: float) -> str:
    """Return a note that strains are not drawn, and why; empty where they are drawn.

    They are not drawn where they are small beside strains of bending and differ from cell to cell.
    """
    jump = surface.strain_jump or 0.0
    if not {*STRAINS, *MOMENTS} <= surface.fields.keys() or jump < UNRESOLVED_JUMP:
        return ""
    # M R/D is about R times a change of curvature; times h/2, over R, it is the strain at the faces
    membrane, bending = _largest(surface, STRAINS), h / 2 * _largest(surface, MOMENTS)
    if not 0 < membrane < SMALL_STRAIN * bending:
        return ""
    ratio = "more than 10 000"  # the inverse of UNKNOWN_RATIO
    if membrane > UNKNOWN_RATIO * bending:
        ratio = f"{float(f'{bending / membrane:.1g}'):.0f}"
    return (
        f"Strains of the mid-surface are not drawn: those of bending are {ratio} times larger, "
        f"and the former differ from cell to cell by {100 * jump:.2g} % (rms)."
    )


def stretches(surface: Surface) -> list[ColouredField]:
    """Return stretches and true stresses of rubber as coloured fields; stresses are white at zero.

    Nodes of shells of another law are nan.
    """
    fields = []
    for name in STRETCHES:
        if (values := surface.fields.get(name)) is not None:
            caption = field_caption(name)
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            if name.startswith("sigma"):
                # rounding of a stress that is zero stays pale
                limits = from_zero(low, max(high, ZERO_STRESS["E_1"]))
                fields.append(ColouredField(name, values, limits, SIGNED, caption))
            else:
                limits = round_limits(low, max(high, low + MIN_STRETCH_RANGE))
                fields.append(ColouredField(name, values, limits, MAGNITUDE, caption))
    return fields


def jump_note(jump: float | None, quantities: str) -> str:
    """Return a note on how far the cells' own values are from the smooth field that is drawn.

    Parameters
    ----------
    jump
        Rms of their difference over the rms of the field; None gives an empty note.
    quantities
        "strains" or "moments".
    """
    if jump is None:
        return ""
    rms = 100 * jump
    difference = f"by {rms:.2g} %" if rms >= MIN_JUMP else f"by less than {MIN_JUMP:g} %"
    return (
        f"Smoothed across cells, whose own {quantities} differ from what is drawn "
        f"{difference} (rms)."
    )


def _largest(surface: Surface, names: Iterable[str]) -> float:
    """Return the largest magnitude of the scalar fields `names` at any node."""
    return max(float(np.abs(surface.fields[name]).max()) for name in names)


def _principal(
    surface: Surface, names: tuple[str, str], jump: float | None
) -> tuple[list[ColouredField], list[str]]:
    """Return two principal fields with the same colours, white at zero, and notes.

    The common limit makes rounding of a constant field invisible. A field that is zero beside the
    other, or no larger than the noise of the mesh, is named in a note and not drawn.

    Parameters
    ----------
    names
        Names of the fields, the larger principal value first.
    jump
        Difference of the cells' own values from the smooth field, relative; None for 0.
    """
    if not set(names) <= surface.fields.keys():
        return [], []
    first_name, second_name = names
    # LIMIT_OVER_NOISE times the noise of the mesh: with that limit of colours the noise is pale
    limit_of_noise = _limit_far_above_noise(surface, first_name, second_name, jump or 0.0)
    limit = max(_limit_without_peaks(surface, first_name, second_name), limit_of_noise)
    fields, notes = list[ColouredField](), list[str]()
    magnitudes = {name: float(np.abs(surface.fields[name]).max()) for name in names}
    for name in names:
        values, words = surface.fields[name], FIELDS[name].words
        if magnitudes[name] < ZERO_FRACTION * max(magnitudes.values()):
            notes.append(f"The {words} is zero everywhere.")
            continue
        rms = float(np.sqrt((values**2).mean()))
        if rms < limit_of_noise / LIMIT_OVER_NOISE:
            notes.append(f"The {words} is zero but for the mesh.")
            continue
        # the common limit on each side of zero, and zero on a side where the field has no values
        lowest, highest = from_zero(float(values.min()), float(values.max()), ZERO_FRACTION)
        limits = (-limit if lowest < 0 else 0.0, limit if highest > 0 else 0.0)
        if max(magnitudes.values()) < ZERO_STRESS[first_name]:  # both are zero: white
            limits = -limit, limit
        fields.append(ColouredField(name, values, limits, SIGNED, field_caption(name)))
    return fields, notes


def _limit_far_above_noise(surface: Surface, first: str, second: str, jump: float) -> float:
    """Return a colour limit far above the noise of the mesh in two principal fields.

    With it a field that is zero but for the mesh is pale. `first` and `second` are the names of the
    fields. `jump` is the relative difference of the cells' own values from the smooth fields.
    """
    squares = surface.fields[first] ** 2 + surface.fields[second] ** 2
    return LIMIT_OVER_NOISE * jump * float(np.sqrt(squares.mean()))


def _limit_without_peaks(surface: Surface, first: str, second: str) -> float:
    """Return the colour limit of two fields: their largest magnitude, without peaks of small area.

    Such a peak is at a point load, for instance. `first` and `second` are the names of the fields.
    """
    magnitude = np.maximum(np.abs(surface.fields[first]), np.abs(surface.fields[second]))
    if (largest := float(magnitude.max())) < ZERO_STRESS[first]:
        return 1.0
    in_cells = magnitude[surface.cells].mean(axis=1)
    a, b, c = np.moveaxis(surface.r0[surface.cells[:, :3]], 1, 0)  # corners of all cells
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # the magnitude that all but a small part of the area does not exceed
    order = np.argsort(in_cells)
    area_up_to_cell = np.cumsum(area[order])
    cell_number = np.searchsorted(area_up_to_cell, AREA_QUANTILE * area.sum())
    quantile = in_cells[order][cell_number]
    return float(min(largest, max(PEAK * quantile, ZERO_STRESS[first])))


def couple(surface: Surface) -> Array | None:
    """Return the couple (n, 3) of the field on the carried remanence per area, over h E λ_m.

    None without a field. λ_m is the largest magnitude of the applied field; in a uniform field the
    result is the product of unit vectors.
    """
    fields = surface.fields
    if not {"Br", "Ba"} <= fields.keys():
        return None
    largest = float(np.nan_to_num(np.linalg.norm(fields["Ba"], axis=1)).max())
    if not largest:
        return None
    return np.asarray(np.cross(fields["Br"], fields["Ba"]) / largest, np.float64)


def loads(surface: Surface, h: float) -> tuple[list[ColouredField], str]:
    """Return the magnetic loads that are not zero everywhere, and a note on the others.

    Loads do not depend on the thickness `h` in their units, so it is not used here.
    """
    fields = surface.fields
    magnetic_couple = couple(surface)
    if magnetic_couple is None:
        return [], ""
    coloured, zero_loads, unknown_loads = [], [], []
    for name, words in LOADS.items():
        values = magnetic_couple if name == "couple" else fields.get(name)
        if values is None:
            unknown_loads.append(words)
            continue
        has_sign = values.ndim == 1  # a scalar; of a vector the length is drawn
        values = np.nan_to_num(values if has_sign else np.linalg.norm(values, axis=1))
        largest, caption = float(np.abs(values).max()), field_caption(name)
        if largest < ZERO_LOAD:
            zero_loads.append(words)
            continue
        if has_sign:
            limits = from_zero(float(values.min()), float(values.max()))
            coloured.append(ColouredField(name, values, limits, SIGNED, caption))
        else:
            coloured.append(ColouredField(name, values, (0.0, largest), MAGNITUDE, caption))
    notes = [f"Zero everywhere: {', '.join(zero_loads)}."] if zero_loads else []
    if unknown_loads:
        notes.append(f"Not defined for this remanence or field: {', '.join(unknown_loads)}.")
    return coloured, " ".join(notes)


def contact(surface: Surface) -> list[ColouredField]:
    """Return gap and contact pressure as coloured fields.

    Empty where nothing touches; the gap alone where the mesh resolves no pressure.
    """
    if not {"gap_over_h", "contact_pressure"} <= surface.fields.keys():
        return []
    gap, pressure = surface.fields["gap_over_h"], surface.fields["contact_pressure"]
    if not (np.isnan(pressure).any() or pressure.any()):
        return []
    caption = field_caption("gap_over_h")
    layers = [ColouredField("gap_over_h", gap, (0.0, 1.0), DISTANCE, caption)]
    if (largest := _largest_resolved(surface)) > 0:
        caption = field_caption("contact_pressure")
        layers.append(ColouredField("contact_pressure", pressure, (0.0, largest), SIGNED, caption))
    return layers


def _largest_resolved(surface: Surface) -> float:
    """Return the largest contact pressure that the mesh resolves, over E h/R; 0 if it is minor.

    A pressure is nan where the contact is narrower than a cell.
    """
    pressure, peak = surface.fields["contact_pressure"], surface.contact_peak
    largest = float(np.nan_to_num(pressure).max())
    is_minor = np.isnan(pressure).any() and peak and largest < MINOR_PRESSURE * peak.pressure
    return 0.0 if is_minor else largest


def pressure_note(surface: Surface, sizes: CaseSizes = NO_UNITS) -> str:
    """Return the note under the contact pressure.

    It says that no cell resolves the pressure, and the force per length; or the largest pressure
    at a quadrature point, and that few cells carry it. `sizes` are those of the case.
    """
    pressure = surface.fields["contact_pressure"]
    is_unresolved, peak = np.isnan(pressure).any(), surface.contact_peak
    if not _largest_resolved(surface):
        words = "The contact is narrower than a cell of the mesh, so that no pressure is drawn."
        return f"{words} {_line_force_text(peak, sizes)}".strip() if peak else words
    notes = []
    if is_unresolved:
        notes = ["Where the contact is narrower than a cell of the mesh, no pressure is drawn."]
    elif 0 < (number := int((pressure[surface.cells] > 0).all(axis=1).sum())) < MIN_PRESSED_CELLS:
        notes = [f"The pressure is a mean over each cell; {number} carry it."]
    if peak:
        largest_pressure, size = in_case_unit(FIELDS["contact_pressure"], sizes, peak.pressure)
        symbol = largest_pressure.latex.replace(" ", "")
        unit = f" {largest_pressure.shown_unit}" if largest_pressure.shown_unit else ""
        notes.append(
            f"The largest at a quadrature point is {symbol} = "
            f"{size * peak.pressure:.3g}{unit}{_error_text(peak.pressure_error)}."
        )
    return " ".join(notes)


def _line_force_text(peak: ContactPeak, sizes: CaseSizes) -> str:
    """Return a sentence on the force of a contact whose pressure the mesh does not resolve."""
    error_text = _error_text(peak.force_error)
    if isnan(peak.line_force):
        return f"Its force is {_amount(peak.force, CONTACT_FORCE, sizes)}{error_text}."
    line_force = _amount(peak.line_force, MEMBRANE_FORCE, sizes)
    measure = "has the median" if peak.is_median else "is at most"
    return f"Its force per length {measure} {line_force}{error_text}."


def _amount(value: float, unit: Unit, sizes: CaseSizes) -> str:
    """Return a number over a unit, and the unit in TeX; or both in the unit of a case."""
    size = unit.size(sizes)
    if isnan(size):
        return f"{value:.3g} ${unit.key.replace(' ', '')}$"
    factor, prefixed_unit = with_prefix(size * value, unit.si)
    return f"{factor * size * value:.3g} {prefixed_unit}"


def _error_text(relative_error: float) -> str:
    """Return words on an estimated relative error, behind a number; none if it is unknown."""
    if isnan(relative_error):
        return ""
    return f", with an error of {100 * relative_error:.1g}\u00a0% by the mesh"


def contact_region(surface: Surface) -> Array | None:
    """Return eight places (8, 3) around the contact, the corners of a box.

    None without contact, or if the contact is large enough to be seen in a picture of the whole
    shell.
    """
    r = surface.r0 + surface.u
    is_pressed, is_near = surface.fields["contact_pressure"] > 0, surface.fields["gap_over_h"] < 1
    in_contact = r[is_pressed | is_near]
    if not len(in_contact):
        return None
    low, high = in_contact.min(axis=0), in_contact.max(axis=0)
    size = float((high - low).max())
    if size > MAX_CONTACT_SIZE * float(np.ptp(r, axis=0).max()):
        return None
    # of a cube with edges of length one around the origin
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    return np.asarray((low + high) / 2 + CONTACT_MARGIN * size * corners)
