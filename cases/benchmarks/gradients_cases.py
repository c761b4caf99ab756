"""The cases of the table of gradients: small ones, which together have every part that a case file
can have.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Compared:
    """A case, the results that are differentiated, and fields that have a number of their own.

    Attributes
    ----------
    fields
        Field -> a key, and by what the field changes at places (cells, nodes, 3) with this number.
    at
        Values of keys that the case file has as text.
    """

    account: str
    text: str
    results: tuple[str, ...]
    fields: Mapping[str, tuple[str, Callable[[Array], Array]]] = field(default_factory=dict)
    at: Mapping[str, float] = field(default_factory=dict)


def even(*components: float) -> Callable[[Array], Array]:
    """A field that is the same everywhere."""
    return lambda x: np.broadcast_to(np.array(components), (*x.shape[:-1], len(components)))


POLAR, AZIMUTH = np.radians(60.0), np.radians(20.0)
TURNED = np.radians(1.0) * np.array(
    [np.cos(POLAR) * np.cos(AZIMUTH), np.cos(POLAR) * np.sin(AZIMUTH), -np.sin(POLAR)]
)  # of the remanence, with its polar angle in degrees
WAVY = "sin(3*x)*(1 + y)"
STRIP = """
shell:
  geometry: strip
  radius: 30 mm
  width: 0.2
  thickness: 0.5 mm
  youngs_modulus: 1 MPa
  poisson_ratio: 0.3
  density: 1200 kg/m^3
"""
FLAWED = (
    STRIP
    + f"""
  thickness_factor: 1.1
  imperfections:
    - {{kind: gaussian, amplitude: 0.3, width: 2, at: {{point: [12 mm, 1 mm, 0]}}}}
    - {{kind: formula, w0: {WAVY}, amplitude: 0.4}}
"""
)
HELD = """
boundary: {root: clamped}
points: {tip: [30 mm, 0, 0]}
mesh: {degree: 3, refinement: 0.5}
symmetry: none
reactions: true
"""
IN_FIELD = """
magnetic:
  remanent: {polar: 60, azimuth: 20, flux_density: 30 mT}
  applied:
    polar: 30
    azimuth: 50
    flux_density: 4 mT
    uniform: 0.9
    gradient: [[0.2, 0.1, 0.3], [0.1, -0.1, 0.2], [0.3, 0.2, -0.1]]
"""
GROWN = """
natural: {curvature: [8, 3, 1], stretch: [1.02, 1.01], along: [1.0, 0.3, 0.0]}
"""
SOURCES = """
magnetic:
  remanent: {polar: 60, azimuth: 20, flux_density: 30 mT}
  applied:
    sources:
      - kind: cylinder
        diameter: 12 mm
        height: 8 mm
        polarization: 1.2 T
        position: [10 mm, 3 mm, -20 mm]
        axis: {polar: 20, azimuth: 10}
      - kind: cuboid
        dimension: [8 mm, 6 mm, 10 mm]
        polarization: [0.3 T, 0.1 T, 1 T]
        spin: 15
        position: [25 mm, 0, 22 mm]
      - {kind: sphere, diameter: 9 mm, polarization: 0.9 T, position: [0, -6 mm, 19 mm]}
      - kind: ring
        diameter: 20 mm
        inner_diameter: 8 mm
        height: 5 mm
        polarization: 0.5 T
        position: [35 mm, 0, -18 mm]
      - {kind: coil, diameter: 40 mm, current: 20 A, turns: 30}
      - {kind: coil, vertices: [[0, 0, 9 mm], [20 mm, 0, 12 mm], [10 mm, 12 mm, 15 mm], \
[0, 0, 9 mm]], current: 300 A}
      - {kind: formula, components: [0.1*z, 0.2*y, 1 + 0.1*x - 0.3*z], flux_density: 3 mT, \
position: [5 mm, 0, 0]}
loading: {kind: field, points: 1}
"""
CAP = """
shell:
  geometry: cap
  radius: 20 mm
  thickness: 0.4 mm
  polar: 60
  youngs_modulus: 1 MPa
  poisson_ratio: 0.45
  density: 1200 kg/m^3
  imperfections: [{kind: gaussian, amplitude: 0.5, width: 2}]
boundary: {rim: clamped}
points: {A: [0, 0, 20 mm]}
mesh: {degree: 3}
foundation: {stiffness: 5 kPa/mm}
magnetic:
  remanent: {flux_density: 80 mT}
  applied:
    sources: [{kind: cylinder, diameter: 20 mm, height: 10 mm, polarization: 1.2 T, \
position: [0, 0, -15 mm]}]
"""


def pressed(body: str) -> str:
    """The cap under a body."""
    return (
        CAP
        + f"""
bodies: {{body: {{{body}, stiffness: 1.0e+6}}}}
loading: [{{kind: field, points: 1}}, {{kind: contact, approach: 0.6 mm, points: 1}}]
"""
    )


def pressed_strip(body: str) -> str:
    """The strip under a body beside its middle line."""
    return (
        STRIP
        + HELD
        + f"""
bodies: {{body: {{{body}, stiffness: 1.0e+4}}}}
loading: {{kind: contact, approach: 1.5 mm, points: 1}}
"""
    )


BUCKLED = """
shell:
  geometry: hemisphere
  radius: 25 mm
  thickness: 0.3 mm
  youngs_modulus: 1.2 MPa
  poisson_ratio: 0.45
  defect: {kind: dimple, amplitude: 1.2, width: 3.2}
boundary: {equator: clamped}
magnetic: {remanent: {flux_density: 60 mT}, applied: {flux_density: 15 mT}}
"""
LAYERS = """
magnetic:
  lambda_m: 3.0e-5
  remanent: {kind: layers, layers: [{polar: 60, fraction: 0.4}, \
{polar: 100, azimuth: 30, fraction: 0.6}]}
  applied: {polar: 20}
"""
PATCHES = """
shell:
  geometry: hemisphere
  radius_to_thickness: 60
  poisson_ratio: 0.45
  defect: {kind: dimple, amplitude: 1.2, width: 3}
boundary: {equator: clamped}
points: {A: [0, 0, 1]}
magnetic: {lambda_m: 0.001, remanent: {kind: patches, \
patches: {dimple: {polar: 0}, rest: {polar: 180}}}, applied: {}}
natural: {curvature: {dimple: [0.3, 0.2, 0.0], rest: 0.1}}
loading: {kind: pressure, control: load, until: target, pressure: 0.2, points: 1}
"""
SOLID = """
model: solid
shell: {geometry: strip, radius_to_thickness: 20, width: 0.2, poisson_ratio: 0.5}
boundary: {root: clamped}
points: {tip: [1, 0, 0]}
magnetic: {lambda_m: 4.0e-4, remanent: {polar: 60}, applied: {polar: 0}}
natural: {curvature: [0.2, 0.1, 0.0], stretch: [1.01, 1.005]}
foundation: {stiffness: 1.0e-5}
mesh: {refinement: 0.5}
"""
GAS = """
loading:
  - {kind: pressure, control: load, until: target, pressure: 40 Pa, points: 1}
  - {kind: field, points: 1, hold: {pressure: {gas: {ambient: 100 Pa}}}}
"""
CASES = {
    "strip in a field": Compared(
        (
            "A strip with two imperfections, an oblique natural shape, a remanence, "
            "and a field with a gradient."
        ),
        FLAWED
        + HELD
        + IN_FIELD
        + GROWN
        + """
loading:
  - {kind: natural, points: 1, curvature: 1}
  - {kind: natural, points: 1, stretch: 1}
  - {kind: field, points: 1}
""",
        ("energy", "tip_uz", "root_fx"),
        {
            "thickness": ("shell.thickness_factor", even(1.0)),
            "magnitude": ("magnetic.remanent.flux_density", even(1 / 0.03)),
            "remanence": ("magnetic.remanent.polar", even(*TURNED)),
            "curvature": ("natural.curvature.0", even(0.03, 0, 0)),
            "deviation": (
                "shell.imperfections.1.amplitude",
                lambda x: (np.sin(3 * x[..., :1]) * (1 + x[..., 1:2])) / 60,
            ),
        },
        {
            "shell.thickness_factor": 1.1,
            "magnetic.remanent.flux_density": 0.03,
            "magnetic.remanent.polar": 60.0,
            "natural.curvature.0": 8.0,
            "shell.imperfections.1.amplitude": 0.4,
        },
    ),
    "spinning strip": Compared(
        "A strip on springs, with a weight, that turns about an axis.",
        STRIP
        + HELD
        + """
foundation: {stiffness: 0.5 kPa/mm, tangential: 0.3 kPa/mm}
loading:
  - {kind: dead, loads: [{over: all, per_area: [0, 0, -2 Pa]}], factor: 1, points: 1}
  - {kind: spin, speed: 100 rpm, points: 1}
""",
        ("energy", "tip_uz"),
    ),
    "strip among magnets": Compared(
        "Magnets and coils of each kind around a strip.",
        STRIP + HELD + SOURCES,
        ("energy", "tip_uz"),
    ),
    "vibrating strip": Compared(
        "Its frequencies in the field.",
        FLAWED + HELD + IN_FIELD + "loading: {kind: field, points: 1}",
        ("omega2_1", "hertz_2"),
    ),
    "layers": Compared("Layers of a thickness.", STRIP + HELD + LAYERS, ("energy", "tip_uz")),
    "ball": Compared(
        (
            "A cap on springs above a magnet, under a ball: a meridian, "
            "where what is not symmetric is refused."
        ),
        pressed("kind: sphere, radius: 8 mm, at: {polar: 0}"),
        ("energy", "A_uz", "force"),
    ),
    "plane": Compared("The cap under a plane.", pressed("kind: plane"), ("A_uz", "force")),
    "rod": Compared(
        "The cap under a rod.", pressed("kind: rod, radius: 3 mm, edge: 1 mm"), ("A_uz", "force")
    ),
    "ellipsoid": Compared(
        "A strip under an ellipsoid that stands obliquely.",
        pressed_strip(
            "kind: ellipsoid, semi_axes: [6 mm, 4 mm, 5 mm], axis: [1.0, 0.5, 0.0], "
            "position: [20 mm, 1 mm, 6 mm], "
            "direction: [0.1, 0.0, -1.0]"
        ),
        ("tip_uz", "force"),
    ),
    "cylinder": Compared(
        "A strip under a cylinder.",
        pressed_strip(
            "kind: cylinder, radius: 4 mm, axis: [0.2, 1.0, 0.0], position: [20 mm, 0, 5 mm], "
            "direction: [0.0, 0.0, -1.0]"
        ),
        ("tip_uz", "force"),
    ),
    "box": Compared(
        "A strip under a box.",
        pressed_strip(
            "kind: box, size: [6 mm, 5 mm, 4 mm], edge: 1 mm, axis: [1.0, 0.3, 0.0], "
            "at: {point: [20 mm, 1 mm, 0]}"
        ),
        ("tip_uz", "force"),
    ),
    "buckled hemisphere": Compared(
        "A dimpled hemisphere at its buckling pressure.",
        BUCKLED + "loading: {kind: pressure, until: limit}",
        ("knockdown", "buckling_pressure_Pa"),
    ),
    "buckled by a field": Compared(
        "The same under a pressure, at its critical field.",
        BUCKLED.replace("15 mT", "-15 mT")
        + """
loading:
  - {kind: pressure, control: load, until: target, pressure: 0.3, points: 2}
  - {kind: field, until: limit}
""",
        ("critical_field", "critical_field_mT"),
    ),
    "poked": Compared(
        "The energy barrier of the same under a pressure.",
        BUCKLED
        + """
loading:
  - {kind: pressure, control: load, until: target, pressure: 0.3, points: 2}
  - {kind: indentation, at: {polar: 0}, control: arc, until: zero}
""",
        ("barrier",),
    ),
    "over gas": Compared(
        "The cap over a gas that is held.",
        CAP + GAS,
        ("A_uz", "pressure"),
    ),
    "patches": Compared("Remanence and natural curvature by patches.", PATCHES, ("A_uz", "energy")),
    "solid": Compared("A strip as a body in three dimensions.", SOLID, ("energy", "tip_uz")),
}
