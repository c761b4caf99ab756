"""report.html: a run in one file, made from the files of its folder."""

import base64
import io
from collections.abc import Iterator, Sequence
from math import isnan
from pathlib import Path
from typing import Any

import yaml
from markupsafe import Markup

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.modes import Frequency, read_frequencies
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
from magshell_fenicsx.output.store.known import headline, is_flat, pole_of, shell_of
from magshell_fenicsx.output.store.table import SOLUTION, Row, read_rows, stability
from magshell_fenicsx.platform.disk_cache import load_cached, save_cached
from magshell_fenicsx.quantities.registry import amplitude, shown_quantity

NAME, TEMPLATE = "report.html", "report_template.html"
FOLDED = 30  # a table with at least so many points is folded
PICTURES = {  # in the order of the report
    "curve.png": "Load over displacement; dashed where the shell is unstable.",
    "sensors.png": "What the sensors read of the field; dashed where the shell is unstable.",
    "field_maps.png": "The magnetic field beside the shell at the last point: field lines and |B|.",
    "solutions.png": "The end of the path, and the solutions that the search has found.",
    "shell.png": "The deformed shell at the last point, coloured by the inward displacement w/h.",
    "animation.gif": "The shell along the path.",
    "magnetic_loads.png": "The magnetic energy read as loads on the deformed shell, at the last point.",
    "strains.png": "Strains of the mid-surface at the last point.",
    "stretches.png": "Stretches of the mid-surface and true stresses at the last point.",
    "moments.png": "Bending moments at the last point.",
    "contact.png": "Gap and contact pressure at the last point.",
    "fields.png": "Fields on the deformed shell at the last point.",
    "instabilities.png": "Null vectors at the instabilities, on the deformed shell: how it buckles.",
    "gradients.png": "Where a result would change most: red where more of a field raises it, blue where it lowers it.",
    "frequencies.png": "Natural frequencies; below zero the shell is unstable.",
    "modes_*.png": "The modes of least stiffness, on the deformed shell.",
}
SMALL = ("curve.png", "shell.png")  # beside each other
SOLUTION_COLUMNS = ("w_over_h", "w_pole_over_h", "volume_change", "energy")
ADAPTED = ("hemisphere", "disc", "strip")  # geometries with mesh.tolerance
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
    """Write report.html from summary.json, path.csv, the pictures and the fields in a run's folder.

    Parameters
    ----------
    playable
        Whether it has the shell to turn and the path to walk along.

    Raises
    ------
    OSError
        If summary.json or path.csv is missing, or the report cannot be written; an older report
        stays unchanged.
    """
    write_whole(folder / NAME, report(folder, playable=playable).encode())


def report(folder: Path, *, playable: bool = True) -> str:
    """The content of report.html."""
    from jinja2 import (
        BytecodeCache,
        Environment,
        FileSystemLoader,
        StrictUndefined,
    )  # takes long to import
    from jinja2.bccache import Bucket

    class Compiled(BytecodeCache):
        """Python's code of the template; Jinja checks that it is that of the file and of this
        Python.
        """

        def load_bytecode(self, bucket: Bucket) -> None:
            if code := load_cached(f"template_{bucket.key}"):
                bucket.bytecode_from_string(code)

        def dump_bytecode(self, bucket: Bucket) -> None:
            save_cached(f"template_{bucket.key}", bucket.bytecode_to_string())

    loader = FileSystemLoader(Path(__file__).parent)
    made = Environment(
        loader=loader,
        bytecode_cache=Compiled(),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return made.get_template(TEMPLATE).render(_content(folder, playable))


def _content(folder: Path, playable: bool) -> dict[str, Any]:
    """The values of the template."""
    summary, lines = read_run(folder)
    played = (
        interactive(folder, summary["case"]) if playable else None
    )  # it moves in place of the animation
    classical = not is_flat(summary["case"]) or any(float(line["p_over_pc"]) for line in lines)
    path = path_table(
        lines, "m" if summary["dimensions"]["units"] == "SI" else "", pole_of(summary["case"])
    )
    return {
        "name": folder.resolve().name,
        "summary": summary,
        "verdict": verdict(summary, lines),
        "groups": _groups(summary, classical),
        "dimensions": _dimensions(summary, classical),
        "pictures": list(
            _pictures(
                folder, _shown(summary["case"], read_rows(folder / "path.csv")), played is None
            )
        ),
        "interactive": played,
        "pole": pole_head(lines[0] if lines else {}, pole_of(summary["case"])),
        "heads": {name: _head(name, lines[0] if lines else {}) for name in SOLUTION_COLUMNS},
        "instabilities": [_instability(line, summary, lines) for line in located(lines)],
        "solutions": [_solution(it) for it in summary.get("solutions", [])],
        "frequencies": [_frequency(it) for it in read_frequencies(folder)],
        "sensitivities": [(name, number(v)) for name, v in summary["sensitivities"].items()],
        "sensitive": symbol(amplitude(lines[-1]["amplitude"]).column)
        if summary["sensitivities"]
        else "",
        "gradients": [
            row for of, it in summary.get("gradients", {}).items() for row in _gradients(of, it)
        ],
        "how_to_estimate": _how_to_estimate(summary["case"]),
        "path": path,
        "rows": list(zip(*(column.cells for column in path), strict=True)),
        "folded": len(lines) >= FOLDED,
        "case": yaml.safe_dump(
            summary["case"], sort_keys=False, allow_unicode=True, default_flow_style=None, width=110
        ),
        "times": [(name, summary["timing"][key]) for key, name in TIMES.items()],
        "number": number,
    }


def _head(name: str, line: Line) -> Markup:
    """The heading of a column with its unit, and its size where the symbol does not have it."""
    of_column = shown_quantity(name, line)
    where = pole_head(line) if name == "w_pole_over_h" else head(of_column)
    return Markup("{} ({})").format(where, of_column.shown_unit) if of_column.shown_unit else where


def _groups(summary: Summary, classical: bool) -> list[tuple[Markup, Markup]]:
    """Name and value of the numbers without units; `classical`: whether p_c says something of the
    run.
    """
    of, magnetic = summary["dimensionless"], summary["case"].get("magnetic") or {}
    chi = magnetic.get("susceptibility")
    field = "|B<sup>r</sup>||B<sup>a</sup>|/(μ<sub>0</sub>E)"
    if chi is not None and "remanent" not in magnetic:
        field = "|B<sup>a</sup>|/√(μ<sub>0</sub>E)"
    named = {
        "R/h": of["radius_to_thickness"],
        "ν": of["poisson_ratio"],
        f"λ<sub>m</sub> = {field}": of["lambda_m"],
        "Λ<sub>m</sub> = λ<sub>m</sub>R/h": of["Lambda_m"],
        **({"p<sub>c</sub>/E": of["pc_over_E"]} if classical else {}),
    }
    if isinstance(chi, int | float):
        named["susceptibility χ"] = chi
    return [(Markup(name), number(v)) for name, v in named.items()]


def _dimensions(summary: Summary, classical: bool) -> list[tuple[Markup, Markup, str]]:
    """Name, value and unit of the quantities that the case gives with units."""
    dims, magnetic, measured = (
        summary["dimensions"],
        summary["case"].get("magnetic") or {},
        summary.get("in_units", {}),
    )
    named = {
        "radius R": (dims["radius"], "m"),
        "thickness h": (dims["thickness"], "m"),
        "Young’s modulus E": (dims["youngs_modulus"], "Pa"),
        "bending stiffness D": (measured.get("bending_stiffness_N_m"), "N m"),
        "classical pressure p<sub>c</sub>": (
            measured.get("classical_pressure_Pa") if classical else None,
            "Pa",
        ),
        "unit of the force, 2πD/R": (measured.get("unit_force_N"), "N"),
        "remanence |B<sup>r</sup>|": (magnetic.get("remanent", {}).get("flux_density"), "T"),
        "applied |B<sup>a</sup>|": (magnetic.get("applied", {}).get("flux_density"), "T"),
    }
    in_si = dims["units"] == "SI"
    return [
        (Markup(name), number(v), unit if in_si or unit == "T" else "")
        for name, (v, unit) in named.items()
        if v is not None
    ]


def _shown(case: dict[str, Any], rows: Sequence[Row]) -> str:
    """The point at which pictures show the shell, in words."""
    row, last = headline(case, rows), [row for row in rows if row["label"] != SOLUTION][-1]
    return "the last point" if row is last else f"point {row['point']}, the first instability"


def _pictures(folder: Path, shown_at: str, moving: bool) -> Iterator[tuple[str, str, bool]]:
    """Source and caption of each picture in the folder, and whether it is shown small."""
    beside = all(
        _narrow((folder / name).read_bytes()) for name in SMALL if (folder / name).exists()
    )
    for pattern, told in PICTURES.items():
        caption = told.replace("the last point", shown_at)
        for file in sorted(folder.glob(pattern)) if moving or pattern != "animation.gif" else []:
            content = base64.b64encode(light(file.read_bytes())).decode()
            yield (
                f"data:image/{file.suffix[1:]};base64,{content}",
                caption,
                beside and pattern in SMALL,
            )


def _instability(line: Line, summary: Summary, lines: Sequence[Line]) -> dict[str, Any]:
    return {
        "point": line["point"],
        "kind": line["label"],
        "mode": line["mode"] or "–",
        "branch": int(line["branch"]),
        "load": value(line, summary),
        "w": amount(shown_quantity("w_over_h", line).name, line, lines),
        "pole": amount(shown_quantity("w_pole_over_h", line).name, line, lines),
    }


def _solution(it: dict[str, Any]) -> list[Markup | str]:
    names = (shown_quantity(name, it).name for name in SOLUTION_COLUMNS)
    numbers = (number(it[name]) for name in names)
    return [
        f"{it['point']}",
        f"{it['solution']}",
        stability(it),
        *numbers,
        number(it["residual"], 2),
    ]


def _frequency(it: Frequency) -> list[Markup | str]:
    return [
        f"{it.point}",
        it.wave or "–",
        number(it.omega2),
        "–" if isnan(it.hertz) else number(it.hertz),
    ]


def _gradients(of: str, it: dict[str, Any]) -> Iterator[list[Markup | str]]:
    """Result, its value, parameter, derivative, and where that by a field is largest."""
    first: list[Markup | str] = [of, number(it["value"])]
    for by, slope in it["numbers"].items():
        yield [*first, by, number(slope), "–", "–"]
    for by, field in it["fields"].items():
        alike = Markup(", ").join(number(v) for v in field["alike"])
        at = ", ".join(f"{x:.3g}" for x in field["at"])
        yield [*first, by, alike, number(field["most_per_area"]), f"({at})"]


def _how_to_estimate(case: dict[str, Any]) -> str:
    """How to get an error estimate, for a run that has none."""
    if "tolerance" in case["mesh"]:
        return "mesh.tolerance was ignored because this run has no scalar result; the default mesh was used"
    if case["model"] == "shell" and shell_of(case)["geometry"] in ADAPTED:
        return "give the case mesh: {tolerance: 1e-3} in place of degree and refinement"
    finer = (
        "mesh.degree one higher"
        if shell_of(case)["geometry"] == "mesh"
        else "mesh.refinement twice as large"
    )
    return f"run it again with {finer} and compare (mesh.tolerance is not offered for this geometry or model)"


def report_of(folder: Path) -> Path:
    """The report of a run's folder, written if it is not there.

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


def opened(file: Path) -> bool:
    """Whether a web browser could be asked to show a file."""
    import webbrowser

    try:
        return webbrowser.open(file.as_uri())
    except webbrowser.Error:
        return False


LARGE = 250_000  # bytes
COLUMN = 120.0  # mm
WIDEST = 1100  # pixels: the width of the page


def _narrow(content: bytes) -> bool:
    """Whether a PNG file has a size of one column of a paper."""
    if not content.startswith(b"\x89PNG"):
        return True
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        return bool(image.width / image.info.get("dpi", (200.0,))[0] * 25.4 < COLUMN)


def light(content: bytes) -> bytes:
    """A PNG file as it is, or if it is large with the page's width, in all its colours; other files
    as they are.
    """
    if len(content) < LARGE or not content.startswith(b"\x89PNG"):
        return content
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        size = min(WIDEST, image.width), round(image.height * min(WIDEST / image.width, 1))
        smaller = image.convert("RGB").resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)
    reduced = io.BytesIO()
    smaller.save(reduced, "PNG", compress_level=6)
    return min(content, reduced.getvalue(), key=len)
