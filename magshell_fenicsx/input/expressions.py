"""Formulas of position in a case file: checked at the door, evaluated with NumPy, no other code reached."""

import ast
import operator
import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field

from magshell_fenicsx.input.taylor import Taylor

Array = NDArray[np.float64]
FUNCTIONS = {name: getattr(np, name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "abs", "sign", "arctan2")}
NAMES = ("x", "y", "z", "pi")
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_ALLOWED = (*(ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Load, ast.Constant), *_OPERATORS)
_Step = tuple[Callable[..., Any], int] | np.float64 | str  # of a stack: a function of some values, a number, a name


def formula(text: str) -> Callable[[Array, Array, Array], Array]:
    """A function of x, y, z (in lengths of R) from text such as "z*sqrt(x**2 + y**2)".

    Raises
    ------
    ValueError
        If the text is anything but arithmetic of x, y, z, pi and the known functions.
    """
    steps = _read(text)
    return lambda x, y, z: np.broadcast_to(np.asarray(_evaluate(steps, x, y, z), dtype=np.float64), x.shape)


def _checked(text: str) -> str:
    formula(text)
    return text


def _of_number(given: Any) -> Any:
    """A number is a formula."""
    return repr(given) if isinstance(given, int | float) and not isinstance(given, bool) else given


Formula = Annotated[
    str,
    BeforeValidator(_of_number, json_schema_input_type=str | float),
    AfterValidator(_checked),
    Field(examples=["z*sqrt(x**2 + y**2)"]),
]


def with_derivatives(text: str) -> Callable[[Array], Taylor]:
    """The same with its first and second derivatives, a function of places (n, 3)."""
    steps = _read(text)

    def evaluate(x: Array) -> Taylor:
        coordinates = Taylor.coordinates(x)
        found = _evaluate(steps, *coordinates)
        return found if isinstance(found, Taylor) else found + 0.0 * coordinates[0]  # a number

    return evaluate


def _read(text: str) -> list[_Step]:
    said = text if len(text) <= 60 else f"{text[:57]}..."
    try:
        tree = ast.parse(text, mode="eval")
        nodes = list(ast.walk(tree))
    except (RecursionError, MemoryError):
        raise ValueError(f"{said!r} is too long: allowed are some thousand terms in a row") from None
    except (SyntaxError, ValueError) as e:
        if "nested parentheses" in str(e):
            raise ValueError(f"{said!r}: allowed are 200 brackets within each other") from None
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
    return _steps(tree)


def _evaluate(steps: list[_Step], x: Any, y: Any, z: Any) -> Any:
    names, stack = {"x": x, "y": y, "z": z, "pi": np.float64(np.pi)}, list[Any]()
    with np.errstate(all="ignore"):
        for step in steps:
            if isinstance(step, tuple):
                function, count = step
                stack[-count:] = [function(*stack[-count:])]
            else:
                stack.append(names[step] if isinstance(step, str) else step)
    return stack[0]


def symbolic(text: str, functions: Mapping[str, Callable[..., Any]], x: Any, y: Any, z: Any) -> Any:
    """A formula of symbols, with the functions that stand for those of `FUNCTIONS`."""
    formula(text)
    instead = {FUNCTIONS[name]: functions[name] for name in FUNCTIONS}
    names, stack = {"x": x, "y": y, "z": z, "pi": float(np.pi)}, list[Any]()
    for step in _steps(ast.parse(text, mode="eval")):
        if isinstance(step, tuple):
            function, count = step
            stack[-count:] = [instead.get(function, function)(*stack[-count:])]
        else:
            stack.append(names[step] if isinstance(step, str) else float(step))
    return stack[0]


def is_formula(text: str) -> bool:
    """Whether `formula` takes it."""
    try:
        formula(text)
    except ValueError:
        return False
    return True


def _steps(tree: ast.Expression) -> list[_Step]:
    """What a stack does in turn: a sum of thousand terms is as many levels deep, too deep for recursion.

    Numbers are NumPy's: these neither grow without end, as 9**9**9 does, nor turn complex.
    """
    steps: list[_Step] = []
    left: list[ast.AST] = [tree.body]
    while left:  # the last operation first, and of its values the last first; then all backwards
        node = left.pop()
        if isinstance(node, ast.BinOp):
            steps.append((_OPERATORS[type(node.op)], 2))
            left += [node.left, node.right]
        elif isinstance(node, ast.UnaryOp):
            steps.append((_OPERATORS[type(node.op)], 1))
            left.append(node.operand)
        elif isinstance(node, ast.Call):
            assert isinstance(node.func, ast.Name)
            steps.append((FUNCTIONS[node.func.id], len(node.args)))
            left += node.args
        elif isinstance(node, ast.Name):
            steps.append(node.id)
        else:
            assert isinstance(node, ast.Constant)
            assert isinstance(node.value, int | float)
            steps.append(np.float64(min(node.value, sys.float_info.max)))
    return steps[::-1]
