"""Ten contacts in time: the largest error of their balance of energy, and how far apart two runs
are whose Poisson's ratios differ by 1e-12, as a table of docs/accuracy.md.

python3 cases/benchmarks/contacts_in_time.py
"""

from typing import Any

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.runs.rows import rows
from magshell_fenicsx.simulate.follow import follow

Section = dict[str, Any]
ENERGIES = ("kinetic", "stored", "dissipated", "work")
DEFLECTION, SMALL = "w_over_h", 1e-12
CLAMPED = {
    "boundary": {"rim": "clamped"},
    "symmetry": "axisymmetric",
    "mesh": {"degree": 3, "refinement": 0.5},
}
PLATE: Section = {
    "shell": {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3},
    **CLAMPED,
}
ROUND = {"geometry": "cap", "polar": 30, "radius": 1.0, "thickness": 0.016, "poisson_ratio": 0.3}
CAP: Section = {"shell": ROUND, **CLAMPED}
STRIP: Section = {
    "shell": {"geometry": "strip", "radius_to_thickness": 50, "poisson_ratio": 0.0, "width": 0.2},
    "boundary": {"root": "clamped"},
    "mesh": {"degree": 3, "size": 1.0},
    "symmetry": "half",
}
BALL = {"ball": {"kind": "sphere", "radius": 0.5, "at": {"polar": 0}}}
FLAT = {"flat": {"kind": "plane", "at": {"polar": 0}}}
ROD = {"rod": {"kind": "rod", "radius": 0.15, "edge": 0.03, "at": {"point": [0.8, 0, 0]}}}
UP = ["0", "0", "0.01*(1-x**2-y**2)**2"]
GAS = {"pressure": {"gas": {"ambient_over_pc": 1e-2, "volume": 0.3}}}
WEIGHT = {
    "kind": "dead",
    "loads": [{"over": "all", "per_area": ["0", "0", "-1e-7"]}],
    "factor": 1,
    "control": "load",
    "points": 1,
}
PRESSED = {"kind": "pressure", "pressure": 1e-3, "control": "load", "until": "target", "points": 1}


def contact(approach: float) -> Section:
    return {"kind": "contact", "approach": approach, "points": 1}


def moving(**more: Any) -> Section:
    return {"kind": "time", "duration": 20.0, "points": 8, **more}


def ramp(name: str, to: float, over: float) -> Section:
    return {name: {"kind": "ramp", "to": to, "over": over}}


LEFT, HELD = contact(-0.5), contact(0.5)
FORCE = {"hold": {"approach": "conjugate"}}
ELASTIC, VISCOUS = {"youngs_modulus": 1.0}, {"viscosity": 0.5}
CASES: dict[str, tuple[Section, Section, list[Section]]] = {
    "plate thrown at a ball": (PLATE, BALL, [LEFT, moving(velocity=UP)]),
    "the same, fixed step": (PLATE, BALL, [LEFT, moving(velocity=UP, rho_inf=1.0, step=0.05)]),
    "plate thrown at a plane": (
        PLATE,
        FLAT,
        [LEFT, moving(velocity=UP, rho_inf=1.0, step=0.02, drag=0.05)],
    ),
    "viscous plate": (
        {**PLATE, "shell": PLATE["shell"] | VISCOUS},
        BALL,
        [LEFT, moving(velocity=UP)],
    ),
    "cap released": (
        CAP,
        BALL,
        [HELD, moving(history=ramp("approach", -1.0, 2.0), rho_inf=1.0, step=0.02)],
    ),
    "ball driven in": (CAP, BALL, [contact(-0.2), moving(history=ramp("approach", 1.0, 10.0))]),
    "gas, load jumps": (
        {**CAP, "shell": ROUND | ELASTIC},
        BALL,
        [HELD, WEIGHT, moving(history={"load": {"kind": "step", "to": 3.0}}, hold=GAS)],
    ),
    "ball of given force": (
        CAP,
        BALL,
        [HELD, PRESSED | FORCE, moving(history=ramp("pressure", 1.1e-3, 10.0), **FORCE)],
    ),
    "strip thrown at a rod": (
        STRIP,
        ROD,
        [
            LEFT,
            moving(velocity=["0", "0", "0.003*x**2"], rho_inf=1.0, step=0.1) | {"duration": 30.0},
        ],
    ),
    "viscous cap on a ball": (
        {**CAP, "shell": ROUND | {"viscosity": 1.0}},
        BALL,
        [HELD, moving(history=ramp("pressure", 1e-3, 1.0), drag=0.05)],
    ),
}


def moved(base: Section, bodies: Section, steps: list[Section], change: float = 0.0) -> list[Row]:
    """The rows in time; with `change` Poisson's ratio is larger by that part of itself, or of one
    where it is zero.
    """
    nu = base["shell"]["poisson_ratio"]
    shell = base["shell"] | {"poisson_ratio": nu + change * (nu or 1.0)}
    scene = Scene(
        Case.from_source(
            Source("contact", {**base, "shell": shell, "bodies": bodies, "loading": steps})
        )
    )
    return [row for row in rows(scene, follow(scene)) if row["step"] == len(steps)]


def imbalance(found: list[Row]) -> float:
    """The largest of a row in time, over its energies."""
    return max(
        abs(float(row["imbalance"])) / sum(abs(float(row[name])) for name in ENERGIES)
        for row in found
    )


def apart(one: list[Row], other: list[Row]) -> float:
    """The largest difference of a deflection of two runs at the same time, over h."""
    assert [row["time"] for row in one] == [row["time"] for row in other]
    return max(
        abs(float(a[DEFLECTION]) - float(b[DEFLECTION])) for a, b in zip(one, other, strict=True)
    )


if __name__ == "__main__":
    print("| contact | imbalance | apart |\n| --- | --- | --- |")
    for name, case in CASES.items():
        once, again = (moved(*case, change) for change in (0.0, SMALL))
        print(f"| {name} | {imbalance(once):.1e} | {apart(once, again):.1e} |", flush=True)
