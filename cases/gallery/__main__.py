"""Every case with a picture, its command, its result and its time, into docs/gallery.

make gallery [ARGS="NAME..."]     # some cases alone: the page keeps the rows of the others
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

# the columns of all parts, by which a path.csv is read
import magshell_fenicsx.parts.registered  # noqa: F401
from magshell_fenicsx.case.examples import CASES, title
from magshell_fenicsx.input.source import read_source
from magshell_fenicsx.output.store.stored_results import case_in
from magshell_fenicsx.output.store.table import read_rows

OUT = CASES.parent / "docs" / "gallery"
WIDTH = 420  # pixels of a picture: 10 to 90 kB
COLUMN = 4.8  # inches
FIRST = (
    "identify.png",
    "designed.png",
    "design.png",
    "boundary.png",
    "ensemble.png",
    "solutions.png",
    "contact.png",
    "gradients.png",
    "shell.png",
)  # that there is
OVER = {  # cases of magshell boundary -> the keys that vary
    "arch_boundary": ["loading.0.factor=0.5:1.9"],
    "cap_boundary": ["shell.polar=15:28"],
    "snap_map": ["shell.defect.amplitude=0.4:2:4", "magnetic.lambda_m=-0.004:0.004:5"],
}
THUMB, COLUMNS = 110, 6  # pixels of a picture in the tables at the head, and pictures in a row
GROUPS = {  # question -> its cases
    "At which load does it buckle?": (
        "dimple_buckling two_dimples cylinder_waves cap_waves_branch dome_on_wall cap_boundary "
        "random_dimples dimple_drift snap_back"
    ),
    "When does it snap, and back?": (
        "bistable_dome arch arch_boundary arch_snap snap_map snapped probing laminated_roof crease "
        "magnet_past_strip magnet_stack strip_buckling soft_strip"
    ),
    "Which force dents it, and what does it press on?": (
        "indentation indentation_snap_back pole_indentation plate_contact ball_contact egg_contact "
        "rod_contact collapsing_tube coaxial_domes stacked_domes dome_lands two_balloons"
    ),
    "How far does it bend?": (
        "gripper gripper_closed magnetic_strip magnet_strip saturated_strip own_field "
        "magnetic_balloon balloon natural_strip standing_strip shortened_strip programme bracket "
        "stiffened_plate clamped_plate foundation tank"
    ),
    "What does a sensor read, how does it ring?": "hall_sensor free_plate spinning_blade",
    "How do I shape or magnetise it, what is my sample?": (
        "designed_letter designed_strip designed_gripper designed_hemisphere designed_neighbour "
        "designed_field designed_thickness designed_shape where_to_magnetise identify_arch "
        "identify_field"
    ),
    "Is a shell good enough?": "solid_buckling solid_indentation",
}
HEAD = """# Gallery

Every case of `cases/`, which `magshell example NAME` writes too. \
CPU time is of the whole process with all files, on
one core of a shared machine, kernels compiled. Made by `make gallery`.
"""


def row(file: Path) -> str:
    """Run a case; its part of the page."""
    data = read_source(file).data
    kind = next((kind for kind in ("ensemble", "design", "identify") if kind in data), "run")
    more = ["--samples", "20", "--seed", "1"] if kind == "ensemble" else []
    if kind == "identify":
        more = ["--data", f"cases/{file.stem}.csv"]
    if over := OVER.get(file.stem):
        kind, more = "boundary", [word for each in over for word in ("--over", each)]
    command, folder = (
        ["magshell", kind, f"cases/{file.name}", *more],
        CASES.parent / "results" / "gallery" / file.stem,
    )
    before = os.times()
    said = subprocess.run(
        [*command, "--out", str(folder)],
        cwd=CASES.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    after = os.times()
    cpu = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    lines = [
        line.strip()
        for line in said.stdout.splitlines()
        if line.strip() and not line.startswith("results in")
    ]
    last = lines[-1] if lines else said.stderr.strip()
    end = f" Ends with exit code {said.returncode}." if said.returncode else ""
    _add_shapes(folder)
    shots = [folder / name for name in (*telling(folder), *FIRST) if (folder / name).exists()]
    if not shots:
        raise SystemExit(f"{file.name}: no picture: {said.stderr.strip() or last}")
    _shrink(shots[0], OUT / f"{file.stem}.png")
    return (
        f"## {file.stem}\n\n{title(file)}.\n\n![{title(file)}]({file.stem}.png)\n\n"
        f"    {' '.join(command)}\n\n"
        f"{last.removesuffix('.')}.{end} CPU time: {cpu:.0f} s.\n"
    )


def thumbnails(names: Sequence[str]) -> str:
    """Return the pictures in small, each a link to its part of the page, by question."""
    groups = {question: cases.split() for question, cases in GROUPS.items()}
    grouped = {name for cases in groups.values() for name in cases}
    groups["Others"] = [name for name in names if name not in grouped]
    tables = []
    for question, cases in groups.items():
        shown = [name for name in cases if name in names]
        if shown:
            rows = [shown[i : i + COLUMNS] for i in range(0, len(shown), COLUMNS)]
            tables.append(f"**{question}**\n\n" + "\n".join(_rows_of_table(rows)) + "\n")
    return "\n".join(tables)


def _rows_of_table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with pictures, each row above its names."""
    picture = '[<img src="{0}.png" width="{1}" alt="{0}" title="{0}">](#{0})'
    lines = []
    for i, names in enumerate(rows):
        blanks = [""] * (len(rows[0]) - len(names))
        pictures = [picture.format(name, THUMB) for name in names]
        lines.append("| " + " | ".join([*pictures, *blanks]) + " |")
        if i == 0:
            lines.append("| " + " | ".join([":-:"] * len(names)) + " |")
        captions = [f"[{name}](#{name})" for name in names]
        lines.append("| " + " | ".join([*captions, *blanks]) + " |")
    return lines


def telling(folder: Path) -> list[str]:
    """The pictures that show the result best: of field maps these, of sensors their readings, of
    motions and snaps the curve, of a bifurcation its mode.

    Where the branch that begins there is followed, that is the shell. Beside bodies and magnets
    these are shown.
    """
    if not (folder / "path.csv").exists():
        return []
    rows = read_rows(folder / "path.csv")
    for name in ("field_maps.png", "sensors.png", "frequencies.png"):
        if (folder / name).exists():
            return [name]
    if rows[-1]["amplitude"] == "time":
        return ["curve.png"]
    steps = case_in(folder).get("loading", [])
    if any(
        step.get("then") == "follow" for step in (steps if isinstance(steps, list) else [steps])
    ):
        return ["shell.png"]
    if any(row["label"] == "bifurcation" for row in rows):
        return ["instabilities.png"]
    beside = {"approach_over_h", "source"} & rows[0].keys()
    return ["curve.png"] if sum(row["label"] == "fold" for row in rows) > 1 and not beside else []


def _add_shapes(folder: Path) -> None:
    """On the curve of a snap: the shell as it is, at its first fold and at the end."""
    if (
        telling(folder) == ["curve.png"]
        and (rows := read_rows(folder / "path.csv"))[-1]["amplitude"] != "time"
    ):
        fold = next(row for row in rows if row["label"] == "fold")
        points = ",".join(str(row["point"]) for row in (rows[0], fold, rows[-1]))
        subprocess.run(
            ["magshell", "plot", str(folder), "--shapes", points], capture_output=True, check=True
        )


def _shrink(source: Path, target: Path) -> None:
    """A picture of one column of a paper has WIDTH pixels, a wider one twice as many: its letters
    stay as large.
    """
    with Image.open(source) as opened:
        wide, picture = (
            opened.width / opened.info.get("dpi", (200.0,))[0] > COLUMN,
            opened.convert("RGB"),
        )
    picture.thumbnail((2 * WIDTH if wide else WIDTH, 10 * WIDTH))
    picture.save(target, optimize=True)


def main(names: list[str]) -> None:
    """Make the page."""
    OUT.mkdir(parents=True, exist_ok=True)
    page = OUT / "README.md"
    known = {
        text.partition("\n")[0]: f"## {text}"
        for text in (page.read_text() if page.exists() else "").split("\n## ")[1:]
    }
    for file in sorted(CASES.glob("*.yaml")):
        if not names or file.stem in names:
            known[file.stem] = row(file)
            print(file.stem, flush=True)
        parts = [
            HEAD,
            thumbnails(sorted(known)),
            *(known[name].strip() + "\n" for name in sorted(known)),
        ]
        page.write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
