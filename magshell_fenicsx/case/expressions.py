"""Formulas of position in a case file: checked at the door, evaluated with NumPy, no other code reached."""

import ast
import sys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FUNCTIONS = {name: getattr(np, name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "abs", "sign", "arctan2")}
NAMES = ("x", "y", "z", "pi")
_ALLOWED = (
    *(ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Load, ast.Constant),
    *(ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.USub, ast.UAdd),
)


def formula(text: str) -> Callable[[Array, Array, Array], Array]:
    """A function of x, y, z (in lengths of R) from text such as "z*sqrt(x**2 + y**2)".

    Raises
    ------
    ValueError
        If the text is anything but arithmetic of x, y, z, pi and the known functions.
    """
    said = text if len(text) <= 60 else f"{text[:57]}..."
    try:
        tree = ast.parse(text, mode="eval")
        nodes = list(ast.walk(tree))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ValueError(f"{said!r} is not a formula") from None
    called = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    for node in nodes:
        known = isinstance(node, _ALLOWED)
        if isinstance(node, ast.Constant):
            known = isinstance(node.value, int | float) and not isinstance(node.value, bool)
        if isinstance(node, ast.Name):
            known = node.id in (FUNCTIONS if id(node) in called else NAMES)
        if isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else ""
            known = name in FUNCTIONS and not node.keywords and len(node.args) == FUNCTIONS[name].nin
        if not known:
            raise ValueError(f"{said!r}: allowed are numbers, {', '.join(NAMES)}, + - * / **, {', '.join(FUNCTIONS)}")
    numbers = _Numbers()
    code = compile(ast.fix_missing_locations(numbers.visit(tree)), "<formula>", "eval")

    def evaluate(x: Array, y: Array, z: Array) -> Array:
        names = {**FUNCTIONS, **numbers.named, "x": x, "y": y, "z": z, "pi": np.pi, "__builtins__": {}}
        with np.errstate(all="ignore"):  # a warning would look for builtins
            return np.broadcast_to(np.asarray(eval(code, names), dtype=np.float64), x.shape)

    return evaluate


class _Numbers(ast.NodeTransformer):
    """Names every number: as NumPy's they neither grow without end, as 9**9**9 does, nor turn complex."""

    def __init__(self) -> None:
        self.named: dict[str, np.float64] = {}

    def visit_Constant(self, node: ast.Constant) -> ast.Name:
        assert isinstance(node.value, int | float)
        name = f"_{len(self.named)}"
        self.named[name] = np.float64(min(node.value, sys.float_info.max))
        return ast.Name(name, ast.Load())
