"""Formulas of position in a case file: checked at the door, evaluated with NumPy, no other code reached."""

import ast
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
    try:
        tree = ast.parse(text, mode="eval")
    except (SyntaxError, ValueError):
        raise ValueError(f"{text!r} is not a formula") from None
    for node in ast.walk(tree):
        known = isinstance(node, _ALLOWED)
        if isinstance(node, ast.Constant):
            known = isinstance(node.value, int | float) and not isinstance(node.value, bool)
        if isinstance(node, ast.Name):
            known = node.id in NAMES or node.id in FUNCTIONS
        if isinstance(node, ast.Call):
            known = isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS and not node.keywords
        if not known:
            raise ValueError(f"{text!r}: allowed are numbers, {', '.join(NAMES)}, + - * / **, {', '.join(FUNCTIONS)}")
    code = compile(tree, "<formula>", "eval")

    def evaluate(x: Array, y: Array, z: Array) -> Array:
        names = {**FUNCTIONS, "x": x, "y": y, "z": z, "pi": np.pi, "__builtins__": {}}
        return np.broadcast_to(np.asarray(eval(code, names), dtype=np.float64), x.shape)

    return evaluate
