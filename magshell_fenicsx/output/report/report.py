"""report.html: a run in one file, made from the files of its folder.

Input: summary.json (`Summary`, a mapping), path.csv, pictures and fields. A line is a row of
path.csv as text: one point of the path. Markup is text that is HTML already, so that the template
does not escape it. `number` writes a number as HTML. The pole is the point whose displacement the
column w_pole_over_h has. p_c is the classical buckling pressure of a sphere. A quantity knows name,
symbol and unit of a column; the shown one is in the case's units if path.csv has such a column.
"""

import base64
import io
from collections.abc import Iterator, Sequence
from math import isnan
from pathlib import Path
from typing import Any

import yaml
from markupsafe import Markup

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.mode_fields import Frequency, read_frequencies
from magshell_fenicsx.output.report.interactive import interactive
from magshell_fenicsx.output.report.verdict import (
    Line,
    Summary,
    amount,
    head,
    located,
    number,
    path_table,
    pole_head,
    read_run,
    symbol,
    value,
    verdict,
)
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.stored_results import headline, is_flat, pole_of, shell_of
from magshell_fenicsx.output.store.table import SOLUTION, Row, read_rows, stability
from magshell_fenicsx.parts.magnetism.fields import GROUPS as GROUPS_OF_FIELD
from magshell_fenicsx.platform.disk_cache import load_cached, save_cached
from magshell_fenicsx.quantities.registry import amplitude, shown_quantity

NAME, TEMPLATE = "report.html", "report_template.html"
MIN_FOLDED_ROWS = 30  # a table with at least so many points is folded
PICTURES = {  # in the order of the report
    "curve.png": "Load over displacement; dashed where the shell is unstable. A band is the "
    "estimated error by the mesh, where it is wider than the line.",
    "sensors.png": "What the sensors read of the field; dashed where the shell is unstable.",
    "field_maps.png": "The magnetic field beside the shell at the last point: field lines and |B|.",
    "solutions.png": "The end of the path, and the solutions that the search has found.",
    "shell.png": "The deformed shell at the last point, coloured by the inward displacement, "
    "and its section; grey is the undeformed shell.",
    "animation.gif": "The shell along the path.",
    "magnetic_loads.png": (
        "The magnetic energy read as loads on the deformed shell, at the last point."
    ),
    "strains.png": "Strains of the mid-surface at the last point.",
    "stretches.png": "Stretches of the mid-surface and true stresses at the last point.",
    "moments.png": "Bending moments at the last point.",
    "contact.png": "Gap and contact pressure at the last point.",
    "fields.png": "Fields on the deformed shell at the last point.",
    "instabilities.png": (
        "Null vectors at the instabilities, on the deformed shell: how it buckles."
    ),
    "gradients.png": (
        "Where a result would change most: red where more of a field raises it, "
        "blue where it lowers it."
    ),
    "frequencies.png": "Natural frequencies; below zero the shell is unstable.",
    "modes_*.png": "The modes of least stiffness, on the deformed shell.",
}
SMALL_PICTURES = ("curve.png", "shell.png")  # side by side
SOLUTION_COLUMNS = ("w_over_h", "w_pole_over_h", "volume_change", "energy")
ADAPTIVE_GEOMETRIES = ("hemisphere", "disc", "strip")  # geometries with mesh.tolerance
TIMES = {
    "jit_s": "compiling kernels",
    "setup_s": "mesh and setup",
    "assembly_s": "assembly",
    "factor_s": "factorisation",
    "solve_s": "solving with factors",
    "output_s": "fields and pictures",
    "total_s": "in all",
}


def write_report(folder: Path, *, playable: bool = True) -> None:
    """Write report.html into a run's folder, from its summary, path.csv, pictures and fields.

    Parameters
    ----------
    playable
        Whether the report has the interactive part.

    Raises
    ------
    OSError
        If summary.json or path.csv is missing, or the report cannot be written; an older report
        stays unchanged.
    """
    write_whole(folder / NAME, report(folder, playable=playable).encode())


def report(folder: Path, *, playable: bool = True) -> str:
    """Return the content of report.html of the run in a folder.

    `playable` is whether the report has the interactive part.
    """
    # Jinja takes long to import
    from jinja2 import BytecodeCache, Environment, FileSystemLoader, StrictUndefined
    from jinja2.bccache import Bucket

    class CompiledTemplates(BytecodeCache):
        """Cache of the template's Python code; Jinja checks the file and the version of Python."""

        def load_bytecode(self, bucket: Bucket) -> None:
            """Give Jinja the compiled template from the disk cache, if it is there."""
            if code := load_cached(f"template_{bucket.key}"):
                bucket.bytecode_from_string(code)

        def dump_bytecode(self, bucket: Bucket) -> None:
            """Put the compiled template into the disk cache."""
            save_cached(f"template_{bucket.key}", bucket.bytecode_to_string())

    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader,
        bytecode_cache=CompiledTemplates(),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE).render(_content(folder, playable))


def _content(folder: Path, playable: bool) -> dict[str, Any]:
    """Return name -> value of all variables of the report's template.

    `playable` is whether the report has the interactive part.
    """
    summary, lines = read_run(folder)
    case = summary["case"]
    pole = pole_of(case)
    first_line = lines[0] if lines else {}
    interactive_part = interactive(folder, case) if playable else None  # it replaces the animation
    # whether p_c means something: it is the pressure of a sphere, on a flat shell only a unit
    classical = not is_flat(case) or any(float(line["p_over_pc"]) for line in lines)
    length_unit = "m" if summary["dimensions"]["units"] == "SI" else ""
    path = path_table(lines, length_unit, pole)
    pictured_point = _pictured_point(case, read_rows(folder / "path.csv"))
    parameter = ""  # symbol of the load, whose value at the fold has the sensitivities
    if summary["sensitivities"]:
        parameter = symbol(amplitude(lines[-1]["amplitude"]).column)
    gradients = list[list[Markup | str]]()
    for result, gradient in summary.get("gradients", {}).items():
        gradients += _gradients(result, gradient)
    return {
        "name": folder.resolve().name,
        "summary": summary,
        "verdict": verdict(summary, lines),
        "groups": _groups(summary, classical),
        "dimensions": _dimensions(summary, classical),
        "pictures": list(_pictures(folder, pictured_point, interactive_part is None)),
        "interactive": interactive_part,
        "pole": pole_head(first_line, pole),
        "heads": {name: _head(name, first_line) for name in SOLUTION_COLUMNS},
        "instabilities": [_instability(line, summary, lines) for line in located(lines)],
        "solutions": [_solution(entry) for entry in summary.get("solutions", [])],
        "frequencies": [_frequency(entry) for entry in read_frequencies(folder)],
        "sensitivities": [(name, number(v)) for name, v in summary["sensitivities"].items()],
        "sensitive": parameter,
        "gradients": gradients,
        "how_to_estimate": _how_to_estimate(case),
        "errors": summary.get("errors", {}),
        "errors_not_estimated": summary.get("errors_not_estimated", {}),
        "errors_folded": len(summary.get("errors", {})) >= MIN_FOLDED_ROWS,
        "path": path,
        "rows": list(zip(*(column.cells for column in path), strict=True)),
        "folded": len(lines) >= MIN_FOLDED_ROWS,
        "case": yaml.safe_dump(
            case, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110
        ),
        "times": [(name, summary["timing"][key]) for key, name in TIMES.items()],
        "number": number,
    }


def _head(name: str, line: Line) -> Markup:
    """Return the heading of a column with its unit, as HTML; `line` is a row of path.csv."""
    of_column = shown_quantity(name, line)
    heading = pole_head(line) if name == "w_pole_over_h" else head(of_column)
    if not of_column.shown_unit:
        return heading
    return Markup("{} ({})").format(heading, of_column.shown_unit)


def _groups(summary: Summary, classical: bool) -> list[tuple[Markup, Markup]]:
    """Return (name, value) of the dimensionless groups, as HTML.

    `classical` is whether the classical pressure p_c means something for the run.
    """
    groups, magnetic = summary["dimensionless"], summary["case"].get("magnetic") or {}
    chi = magnetic.get("susceptibility")  # a number, or a formula
    strength, strength_over_thickness = (groups[name] for name in GROUPS_OF_FIELD)
    # what the strength is made of: for soft material alone there is no remanence in it
    field = "|B<sup>r</sup>||B<sup>a</sup>|/(μ<sub>0</sub>E)"
    if chi is not None and "remanent" not in magnetic:
        field = "|B<sup>a</sup>|/√(μ<sub>0</sub>E)"
    values = {
        "R/h": groups["radius_to_thickness"],
        "ν": groups["poisson_ratio"],
        f"λ<sub>m</sub> = {field}": strength,
        "Λ<sub>m</sub> = λ<sub>m</sub>R/h": strength_over_thickness,
        **({"p<sub>c</sub>/E": groups["pc_over_E"]} if classical else {}),
    }
    if isinstance(chi, int | float):
        values["susceptibility χ"] = chi
    return [(Markup(name), number(v)) for name, v in values.items()]


def _dimensions(summary: Summary, classical: bool) -> list[tuple[Markup, Markup, str]]:
    """Return (name, value, unit) of the quantities that the case gives with units, as HTML.

    Quantities that the case lacks are left out. `classical` is whether the classical pressure p_c
    means something for the run.
    """
    dimensions, measured = summary["dimensions"], summary.get("in_units", {})
    magnetic = summary["case"].get("magnetic") or {}
    classical_pressure = measured.get("classical_pressure_Pa") if classical else None
    ending, length_unit = ("_mm", "mm") if "radius_mm" in dimensions else ("", "m")
    values_and_units = {
        "radius R": (dimensions[f"radius{ending}"], length_unit),
        "thickness h": (dimensions.get(f"thickness{ending}"), length_unit),
        "Young’s modulus E": (dimensions["youngs_modulus"], "Pa"),
        "bending stiffness D": (measured.get("bending_stiffness_N_m"), "N m"),
        "classical pressure p<sub>c</sub>": (classical_pressure, "Pa"),
        "unit of the force, 2πD/R": (measured.get("unit_force_N"), "N"),
        "remanence |B<sup>r</sup>|": (magnetic.get("remanent", {}).get("flux_density"), "T"),
        "applied |B<sup>a</sup>|": (magnetic.get("applied", {}).get("flux_density"), "T"),
    }
    in_si = dimensions["units"] == "SI"  # other units have no name; flux densities are in T anyway
    return [
        (Markup(name), number(v), unit if in_si or unit == "T" else "")
        for name, (v, unit) in values_and_units.items()
        if v is not None
    ]


def _pictured_point(case: dict[str, Any], rows: Sequence[Row]) -> str:
    """Return words for the point at which pictures show the shell; `rows` are those of path.csv."""
    path = [row for row in rows if row["label"] != SOLUTION]
    pictured_row = headline(case, rows)  # the last row of the path, or the first instability
    if pictured_row is path[-1]:
        return "the last point"
    return f"point {pictured_row['point']}, the first instability"


def _pictures(folder: Path, pictured_point: str, animated: bool) -> Iterator[tuple[str, str, bool]]:
    """Yield source, caption and smallness of each picture in a run's folder.

    The source is a data URL of the picture; the last value is whether the picture is shown small.

    Parameters
    ----------
    pictured_point
        Words for the point at which pictures show the shell.
    animated
        Whether the animation is shown.
    """
    # two pictures are side by side if both are narrow
    small_files = [folder / name for name in SMALL_PICTURES if (folder / name).exists()]
    side_by_side = all(_is_narrow(file.read_bytes()) for file in small_files)
    for pattern, template in PICTURES.items():
        caption = template.replace("the last point", pictured_point)  # it may be an instability
        if pattern == "animation.gif" and not animated:
            continue
        is_small = side_by_side and pattern in SMALL_PICTURES
        for file in sorted(folder.glob(pattern)):
            content = base64.b64encode(reduced_picture(file.read_bytes())).decode()
            yield f"data:image/{file.suffix[1:]};base64,{content}", caption, is_small


def _instability(line: Line, summary: Summary, lines: Sequence[Line]) -> dict[str, Any]:
    """Return column -> cell of a row of the table of instabilities.

    `line` is the row of the instability. `lines` are all rows of path.csv; they show which
    displacements are as small as rounding.
    """
    return {
        "point": line["point"],
        "kind": line["label"],
        "mode": line["mode"] or "–",
        "branch": int(line["branch"]),
        "load": value(line, summary),
        "w": amount(shown_quantity("w_over_h", line).name, line, lines),
        "pole": amount(shown_quantity("w_pole_over_h", line).name, line, lines),
    }


def _solution(solution: dict[str, Any]) -> list[Markup | str]:
    """Return the cells of a row of the table of solutions, with stability and residual.

    `solution` is an entry of "solutions" in summary.json.
    """
    names = (shown_quantity(name, solution).name for name in SOLUTION_COLUMNS)
    numbers = (number(solution[name]) for name in names)
    return [
        f"{solution['point']}",
        f"{solution['solution']}",
        stability(solution),
        *numbers,
        number(solution["residual"], digits=2),
    ]


def _frequency(frequency: Frequency) -> list[Markup | str]:
    """Return the cells of a row of the table of frequencies: point, wave, omega2, Hz."""
    return [
        f"{frequency.point}",
        frequency.wave or "–",
        number(frequency.omega2),
        "–" if isnan(frequency.hertz) else number(frequency.hertz),
    ]


def _gradients(result: str, gradient: dict[str, Any]) -> Iterator[list[Markup | str]]:
    """Yield rows of the table of gradients of one result; `gradient` is its entry in summary.json.

    The cells are the result, its value, the parameter, the derivative, the largest derivative per
    area of a field, and where that is.
    """
    first_cells: list[Markup | str] = [result, number(gradient["value"])]
    # derivatives by numbers of the case
    for parameter, derivative in gradient["numbers"].items():
        yield [*first_cells, parameter, number(derivative), "–", "–"]
    # derivatives by fields: "alike" is that by a change that is the same everywhere
    for parameter, field in gradient["fields"].items():
        components = Markup(", ").join(number(v) for v in field["alike"])
        place = ", ".join(f"{x:.3g}" for x in field["at"])
        yield [*first_cells, parameter, components, number(field["most_per_area"]), f"({place})"]


def _how_to_estimate(case: dict[str, Any]) -> str:
    """Return advice on how to get an error estimate, for a run that has none."""
    if "tolerance" in case["mesh"]:  # given, but without an estimate
        return (
            "mesh.tolerance was ignored because this run has no scalar result; "
            "the default mesh was used"
        )
    if case["model"] == "shell" and shell_of(case)["geometry"] in ADAPTIVE_GEOMETRIES:
        return "give the case mesh: {tolerance: 1e-3} in place of degree and refinement"
    finer = (
        "mesh.degree one higher"
        if shell_of(case)["geometry"] == "mesh"
        else "mesh.refinement twice as large"
    )
    return f"run it again with {finer} and compare"


def report_of(folder: Path) -> Path:
    """Return the report of a run's folder, written if it is not there.

    Raises
    ------
    CaseError
        If the folder holds no run with a summary.
    """
    if not (folder / NAME).exists():
        if not (folder / "summary.json").exists():
            raise CaseError(f"{folder} holds no report.html, and no summary.json to make one of")
        write_report(folder)
    return (folder / NAME).resolve()


def open_in_browser(file: Path) -> bool:
    """Ask a web browser to show a file, and return whether one could be asked."""
    import webbrowser

    try:
        return webbrowser.open(file.as_uri())
    except webbrowser.Error:
        return False


LARGE_PICTURE = 250_000  # bytes
MAX_COLUMN_WIDTH = 120.0  # mm
DEFAULT_DPI = 200.0  # of a PNG file that does not say it
PAGE_WIDTH = 1100  # pixels


def _is_narrow(content: bytes) -> bool:
    """Whether a PNG file is no wider than a column of a paper; True of other files."""
    if not content.startswith(b"\x89PNG"):
        return True
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        dpi, *_ = image.info.get("dpi", (DEFAULT_DPI,))  # along the width, then along the height
        return bool(image.width / dpi * 25.4 < MAX_COLUMN_WIDTH)  # 25.4 mm are an inch


def reduced_picture(content: bytes) -> bytes:
    """Return a picture with the page's width, if it is a large PNG file; other files unchanged."""
    if len(content) < LARGE_PICTURE or not content.startswith(b"\x89PNG"):
        return content
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        size = min(PAGE_WIDTH, image.width), round(image.height * min(PAGE_WIDTH / image.width, 1))
        smaller = image.convert("RGB").resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)
    reduced_file = io.BytesIO()
    smaller.save(reduced_file, "PNG", compress_level=6)
    return min(content, reduced_file.getvalue(), key=len)  # the smaller file of both
