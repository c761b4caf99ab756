"""Cases of laminates: lamination theory, the symmetry that plies leave, gradients, fields, and what
is refused.
"""

from typing import Any

import numpy as np
import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.case.case_variants import case_with_values
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.laminate import LaminateSection
from magshell_fenicsx.simulate.perturbation import number_at_key


def case(**sections: Any) -> ms.Case:
    return ms.Case.from_source(sections)


def plies(*angles: float) -> list[dict[str, float]]:
    """Of equal thickness, E1/E2 = 3."""
    common = {"E1": 3.0, "E2": 1.0, "nu12": 0.25, "G12": 0.6, "fraction": 1 / len(angles)}
    return [{"angle": float(angle)} | common for angle in angles]


STRIP = {
    "geometry": "plate",
    "length": 1,
    "width": 0.2,
    "thickness": 0.002,
    "youngs_modulus": 1,
    "poisson_ratio": 0,
}
SIDES = {"left": "clamped", "bottom": "symmetry", "top": "symmetry"}


@pytest.mark.parametrize("load", ["pulled", "bent"])
def test_coupled_strip(load: str) -> None:
    """[0/90] in cylindrical bending, by lamination theory: N = A11 e - B11 k, M = D11 k - B11 e."""
    h, A, B, D = 0.002, *(float(S[0]) for S in LaminateSection(plies=plies(0, 90)).matrices(1.0))
    size = 1e-10
    N, M = (size * h, 0.0) if load == "pulled" else (0.0, size * h**2)
    loads = [{"edge": "right", "force": [0.2 * N, 0, 0]}] if N else [{"edge": "right", "moment": M}]
    shell = STRIP | {"laminate": {"plies": plies(0, 90)}}
    loading = {"kind": "dead", "loads": loads, "factor": 1, "points": 1}
    found = ms.run(
        case(
            shell=shell,
            boundary=SIDES,
            points={"tip": [1, 0.1, 0]},
            loading=loading,
            mesh={"size": 0.1},
        )
    )
    e, k = np.linalg.solve([[A * h, -B * h**2], [-B * h**2, D * h**3]], [N, -M])
    last = found.rows[-1]
    assert float(last["tip_ux"]) == pytest.approx(e, rel=1e-4)
    assert float(last["tip_uz"]) == pytest.approx(k / 2, rel=1e-4)


HEMISPHERE = {"geometry": "hemisphere", "radius_to_thickness": 40, "poisson_ratio": 0.3}
PRESSED = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.3, "points": 1}


def pressed(laminate: dict[str, Any], **sections: Any) -> ms.Case:
    return case(
        **{
            "shell": HEMISPHERE | {"laminate": laminate},
            "boundary": {"equator": "clamped"},
            "loading": PRESSED,
        }
        | sections
    )


@pytest.mark.parametrize(
    ("laminate", "model"),
    [
        ({"plies": plies(0)}, "meridian"),
        ({"plies": plies(90, 0)}, "meridian"),
        ({"plies": plies(45, -45)}, "full shell"),
        ({"plies": plies(0, 90), "along": [1.0, 0.0, 0.0]}, "half shell"),
        ({"plies": plies(0, 90), "along": [1.0, 2.0, 0.0]}, "half shell"),
        ({"plies": plies(0, 90), "along": [1.0, 0.0, 1.0]}, "half shell"),
        ({"plies": plies(0, 90), "along": [0.0, 0.0, 2.0]}, "meridian"),
        ({"plies": plies(0, 30), "along": [1.0, 0.0, 0.0]}, "full shell"),
        ({"plies": plies(30, -30, -30, 30), "along": [1.0, 0.0, 0.0]}, "full shell"),  # D16 stays
        (
            {
                "plies": [
                    {
                        "E1": 1.0,
                        "E2": 1.0,
                        "nu12": 0.3,
                        "G12": 1 / 2.6,
                        "fraction": 1.0,
                        "angle": 20.0,
                    }
                ]
            },
            "meridian",
        ),
    ],
)
def test_symmetry(laminate: dict[str, Any], model: str) -> None:
    assert pressed(laminate).problem().included[0] == model


@pytest.mark.slow
def test_meridian_and_half() -> None:
    """Plies along the meridians: a meridian and half of the surface have the same energy and
    volume.
    """
    laminate = {"plies": plies(0, 90)}
    found = [
        ms.run(pressed(laminate, symmetry=symmetry, mesh=mesh)).rows[-1]
        for symmetry, mesh in (("axisymmetric", {}), ("half", {"refinement": 0.7}))
    ]
    for column in ("energy", "volume_change"):
        assert float(found[0][column]) == pytest.approx(float(found[1][column]), rel=5e-4)
    other = ms.run(pressed({"plies": plies(90, 0)}, symmetry="axisymmetric")).rows[-1]
    assert abs(float(other["volume_change"]) / float(found[0]["volume_change"]) - 1) > 2e-3


@pytest.mark.slow
def test_gradients() -> None:
    """Of the tip of a twisted strip, by differences of runs."""
    numbers = {"plies.0.angle": 30.0, "plies.0.E1": 3.0, "plies.1.G12": 0.6, "plies.0.nu12": 0.25}
    sections: dict[str, Any] = {
        "shell": STRIP | {"thickness": 0.02, "laminate": {"plies": plies(30, 0)}},
        "boundary": {"left": "clamped"},
        "points": {"tip": [1, 0.2, 0]},
        "loading": {
            "kind": "dead",
            "loads": [{"edge": "right", "force": [0, 0, 1e-6]}],
            "factor": 1,
            "points": 1,
        },
        "mesh": {"size": 0.2, "degree": 3},
    }

    def tip(key: str, value: float) -> float:
        return float(ms.run(case_with_values(case(**sections), {key: value})).rows[-1]["tip_uz"])

    scene = ms.Scene(case(**sections))
    *_, last = ms.follow(scene)
    found = ms.gradient(scene, last, of="tip_uz", by=[f"shell.laminate.{by}" for by in numbers])
    for by, value in numbers.items():
        key, step = f"shell.laminate.{by}", 1e-3 * value
        expected = (tip(key, value + step) - tip(key, value - step)) / (2 * step)
        assert found[key] == pytest.approx(expected, rel=1e-4), key


def test_what_is_refused() -> None:
    """Each with its key, the value and what is allowed; all stand in docs/troubleshooting.md."""
    bad = plies(0)[0] | {"nu12": 2.0}
    cap = {
        "geometry": "cap",
        "polar": 40,
        "radius": "1 m",
        "thickness": "2 cm",
        "poisson_ratio": 0.3,
    }
    wrong: dict[str, dict[str, Any]] = {
        "nu12: 2: allowed is nu12^2 < E1/E2 = 3": {"laminate": {"plies": [bad]}},
        "plies: their fractions must add up to 1": {"laminate": {"plies": plies(0, 90)[:1]}},
        "along: a vector of length zero is no direction": {
            "laminate": {"plies": plies(0), "along": [0.0, 0.0, 0.0]}
        },
        "give each of E1, E2, G12 a unit, or none": {
            "laminate": {"plies": [plies(0)[0] | {"E1": "3 GPa"}]}
        },
        "laminate: needs law: koiter": {
            "laminate": {"plies": plies(0)},
            "law": "neo-hookean",
            "poisson_ratio": 0.5,
        },
    }
    for message, keys in wrong.items():
        with pytest.raises(CaseError, match=message.replace("^", r"\^")):
            case(shell=HEMISPHERE | keys, boundary={"equator": "clamped"}, loading=PRESSED)
    shell = cap | {"youngs_modulus": "1 GPa", "laminate": {"plies": plies(0)}}
    with pytest.raises(CaseError, match="their moduli have none: youngs_modulus has one"):
        case(shell=shell, boundary={"rim": "clamped"}, loading=PRESSED)
    with pytest.raises(CaseError, match="mirrors a laminate that twists"):
        case(shell=STRIP | {"laminate": {"plies": plies(20)}}, boundary=SIDES, loading=PRESSED)
    askew = {"laminate": {"plies": plies(0), "along": [1, 1, 0]}}
    with pytest.raises(MeshError, match="boundary: bottom: its plane does not mirror the plies"):
        ms.Scene(case(shell=STRIP | askew, boundary=SIDES, loading=PRESSED))
    upright = {"laminate": {"plies": plies(0), "along": [0, 0, 1]}}
    with pytest.raises(MeshError, match="along: is normal to a part of the shell"):
        ms.Scene(case(shell=STRIP | upright, boundary={"left": "clamped"}, loading=PRESSED))
    with pytest.raises(CaseError, match=r"shell\.laminate: needs a mid-surface"):
        pressed({"plies": plies(0)}, model="solid")
    for laminate, message in (
        ({"plies": plies(45, -45)}, "the laminate is not balanced about the meridian"),
        (
            {"plies": plies(0), "along": [1.0, 0.0, 0.0]},
            "the angle 0 of the plies is not along the meridians",
        ),
    ):
        with pytest.raises(CaseError, match=message):
            pressed(laminate, symmetry="axisymmetric").problem()
    with pytest.raises(
        CaseError, match="the fractions of the plies add up to 1: one alone has no gradient"
    ):
        number_at_key(pressed({"plies": plies(0, 90)}).context, "shell.laminate.plies.0.fraction")
    for size, said in ((1e10, "1e\\+10"), (1e-10, "1e-10")):
        with pytest.raises(
            CaseError,
            match=rf"plies\.0\.E2: is {said} times youngs_modulus: allowed 1e-09 to 1e\+09",
        ):
            pressed({"plies": [plies(0)[0] | {"E1": 1e9, "E2": size, "nu12": 0}]})


@pytest.mark.parametrize("length", [1e-300, 1e300])
def test_a_direction_of_any_length(length: float) -> None:
    """Squares of such lengths are zero and infinite."""
    section = LaminateSection.model_validate({"plies": plies(0), "along": [length, 0.0, length]})
    assert section.direction("plate") == pytest.approx([np.sqrt(0.5), 0, np.sqrt(0.5)])
