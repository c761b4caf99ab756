"""Mutated case files, as bytes: what a tired user, a broken editor or a hostile one may write."""

import copy
import json
import math
from collections.abc import Callable
from functools import cache
from typing import Any

from conftest import CASES
from hypothesis import strategies as st

from magshell_fenicsx.input.source import read_source

Keys = tuple[str | int, ...]

SPHERE = {"geometry": "hemisphere", "radius_to_thickness": 90, "poisson_ratio": 0.5}
LENGTHS = {
    "geometry": "hemisphere",
    "radius": "25.2 mm",
    "thickness": "0.32 mm",
    "poisson_ratio": 0.5,
}
DIMPLED = SPHERE | {"defect": {"kind": "dimple", "amplitude": 1.64, "width": 3.2}}
STRIP = {"geometry": "strip", "radius_to_thickness": 100, "width": 0.1, "poisson_ratio": 0}
CLAMPED = {"equator": "clamped"}
GRADIENT = [[1, 0, 0], [0, 1, 0], [0, 0, -2]]
# sections that no file of cases/ has, in whole cases: every kind of field and load is mutated too
REMANENCES: list[dict[str, Any]] = [
    {"kind": "radial"},
    {"kind": "tangential"},
    {"kind": "expression", "components": ["z", "x*y", "sqrt(x**2 + 1)"]},
    {"kind": "patches", "patches": {"dimple": {"polar": 90}, "rest": {}}},
    {"kind": "layers", "layers": [{"fraction": 0.5}, {"fraction": 0.5, "polar": 90}]},
]
LOADS: list[dict[str, Any]] = [
    {"kind": "field", "until": "limit"},
    {"kind": "rotation", "to": {"polar": 90}, "points": 3},
    {"kind": "pressure", "until": "target", "volume_change": 0.01, "points": 2},
    {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.1, "points": 2},
    {"kind": "indentation", "at": {"polar": 0}, "depth": 1, "points": 2, "patch": 1},
    {"kind": "indentation", "at": {"polar": 20}, "control": "load", "force": 0.1, "points": 2},
]
WHOLE: list[dict[str, Any]] = [
    *(
        {"shell": DIMPLED, "boundary": CLAMPED, "magnetic": {"lambda_m": 1e-3, "remanent": r}}
        for r in REMANENCES
    ),
    *(
        {"shell": SPHERE, "boundary": CLAMPED, "magnetic": {"lambda_m": 1e-3}, "loading": load}
        for load in LOADS
    ),
    {
        "shell": STRIP,
        "boundary": {"root": "clamped"},
        "magnetic": {"lambda_m": 1e-6, "applied": {"gradient": GRADIENT}},
    },
    {
        "shell": LENGTHS | {"youngs_modulus": "1.8 MPa"},
        "boundary": {"equator": "simply supported"},
        "magnetic": {"remanent": {"flux_density": "60 mT"}, "applied": {"flux_density": "0.05 T"}},
        "mesh": {"degree": 3, "refinement": 0.5, "penalty": 20},
        "symmetry": "none",
    },
]
NUMBERS = [
    0,
    1,
    -1,
    1e9,
    -1e9,
    1e300,
    -1e300,
    1e-300,
    5e-324,
    10**40,
    10**400,
    2**63,
    math.nan,
    math.inf,
    -math.inf,
]
WORDS = [
    "",
    " ",
    "clamped",
    "none",
    "half",
    "1 mm",
    "1e400 m",
    "9**9**9 m",
    "1/0 m",
    "0 T",
    "1e-320 Pa",
    "nan mm",
]
WORDS += [
    "9**9**9**9",
    "x(y)",
    "sin()",
    "1/0",
    "log(0)",
    "1/x",
    "lambda: 0",
    "__import__('os')",
    "(" * 300,
]
WORDS += ["\ud800", "\u202e", "a\nb"]
OTHERS = [
    None,
    True,
    [],
    {},
    [[]],
    [1, "a", None],
    {"": {}},
    {"kind": None},
    {"kind": ["pressure"]},
]
NESTED = st.recursive(
    st.none() | st.booleans(),
    lambda inner: (
        st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2)
    ),
)
JUNK = st.one_of(
    st.sampled_from([*NUMBERS, *WORDS]),
    st.sampled_from(OTHERS),
    st.floats(),
    st.text(max_size=8),
    NESTED,
)
FACTORS = [-1, 0, 0.01, 0.1, 0.5, 0.9, 1.1, 2, 10, 100, 1e6, 1e300]
EXTRA_KEYS = ["kind", "polar", "depth", "mesh", "1", "ü", "a.b", "<<"]
CHANGES = ["scale", "scale", "scale", "junk", "junk", "drop", "misspell", "add"]
BROKEN = [
    b"\t",
    b"\xff\xfe",
    b"\x00",
    b"{",
    b"]",
    b"'",
    b": ",
    b"\n- ",
    b"&a ",
    b"*a ",
    b"&a [*a]",
    b"#",
    b"? ",
    b"| ",
]
BROKEN += [
    b"!!int ",
    b"!!timestamp ",
    b"!!binary ",
    b"!!set ",
    b"!!python/object:os.system ",
    b"%YAML 9\n---\n",
]
BROKEN += [b"\n---\n", b"=", b"\xe2\x80\xa8", b"[" * 2000, b"0x" + b"f" * 5000, b"1" * 5000]


@cache
def originals() -> list[dict[str, Any]]:
    """The case files of the repository, and `WHOLE`."""
    return [*(read_source(file).data for file in sorted(CASES.rglob("*.yaml"))), *WHOLE]


def places(data: Any, here: Keys = ()) -> list[Keys]:
    """The keys of every value below `data`."""
    inside = (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    )
    return [
        place for key, value in inside for place in ((*here, key), *places(value, (*here, key)))
    ]


def holder(data: Any, place: Keys) -> Any:
    """What holds the value at a place."""
    for key in place[:-1]:
        data = data[key]
    return data


def leaf(data: Any, place: Keys) -> bool:
    """Whether the value at a place is a number."""
    return isinstance(holder(data, place)[place[-1]], int | float)


@st.composite
def mutated_data(draw: Callable[..., Any]) -> dict[str, Any]:
    """A case with up to three changes."""
    data: dict[str, Any] = copy.deepcopy(draw(st.sampled_from(originals())))
    for _ in range(draw(st.sampled_from([0, 1, 1, 1, 2, 2, 3]))):
        change = draw(st.sampled_from(CHANGES))
        somewhere = [place for place in places(data) if change != "scale" or leaf(data, place)]
        if not somewhere:
            continue
        place = draw(st.sampled_from(somewhere))
        at, key = holder(data, place), place[-1]
        if change == "scale":
            at[key] = draw(st.sampled_from(FACTORS)) * min(at[key], 1e300)
        elif change == "junk":
            at[key] = copy.deepcopy(draw(JUNK))
        elif change == "drop":
            del at[key]
        elif isinstance(at, dict) and isinstance(key, str) and change == "misspell":
            at[draw(st.sampled_from([key[:-1], key + "s", key.upper(), key[1:] + key[:1], ""]))] = (
                at.pop(key)
            )
        elif isinstance(at, dict):
            at[draw(st.sampled_from(EXTRA_KEYS) | st.text(max_size=4))] = copy.deepcopy(draw(JUNK))
    return data


def dumped(data: Any) -> str:
    """YAML of plain data, in braces."""
    if isinstance(data, dict):
        return (
            "{"
            + ", ".join(f"{json.dumps(str(key))}: {dumped(value)}" for key, value in data.items())
            + "}"
        )
    if isinstance(data, list):
        return "[" + ", ".join(map(dumped, data)) + "]"
    if isinstance(data, float) and not math.isfinite(data):
        return {"nan": ".nan", "inf": ".inf", "-inf": "-.inf"}[str(data)]
    return json.dumps(data)


@st.composite
def case_files(draw: Callable[..., Any]) -> bytes:
    """The bytes of a mutated case file; one in five is broken as a text too."""
    data = draw(mutated_data())
    lines = [f"{json.dumps(key)}: {dumped(value)}" for key, value in data.items()]
    if draw(st.integers(0, 15)) == 0 and lines:
        lines.append(draw(st.sampled_from(lines)))  # a doubled section
    text = "\n".join(lines).encode("utf-8", "surrogatepass")
    if draw(st.integers(0, 4)) == 0:
        position = draw(st.integers(0, len(text)))
        removed = draw(st.sampled_from([0, 0, 1, 5, 10**6]))
        text = (
            text[:position]
            + draw(st.sampled_from(BROKEN) | st.binary(max_size=4))
            + text[position + removed :]
        )
    return text
