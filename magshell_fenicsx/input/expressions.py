"""Formulas of a case: parsed, checked and evaluated, with derivatives by Taylor arithmetic."""

import ast
import operator
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field

from magshell_fenicsx.input.enclosure import Enclosure

Array = NDArray[np.float64]

# First derivatives by each argument, second ones by pairs i <= j.
Partials = tuple[list[Any], dict[tuple[int, int], Any]]


@dataclass(frozen=True)
class Taylor(NDArrayOperatorsMixin):
    """A function with its derivatives at places; NumPy's functions of it return these too.

    Attributes
    ----------
    value, gradient, hessian
        (n,), (3, n) and (3, 3, n).
    """

    value: Array
    gradient: Array
    hessian: Array

    @classmethod
    def coordinates(cls, x: Array) -> list[Self]:
        """Return x, y and z at places (n, 3)."""
        ones, zeros = np.ones(len(x)), np.zeros((3, 3, len(x)))
        return [cls(x[:, i], np.eye(3)[i, :, None] * ones, zeros) for i in range(3)]

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
        """Return a function of this and of numbers, by the chain rule."""
        if method != "__call__" or options or ufunc not in PARTIALS:
            return NotImplemented
        values = [a.value if isinstance(a, Taylor) else a for a in arguments]
        varying = [i for i, a in enumerate(arguments) if isinstance(a, Taylor)]
        first, second = PARTIALS[ufunc](*values)
        gradient, hessian = np.zeros_like(self.gradient), np.zeros_like(self.hessian)
        for i in varying:
            gradient = gradient + first[i] * arguments[i].gradient
            hessian = hessian + first[i] * arguments[i].hessian
        for (i, j), partial in second.items():
            if i in varying and j in varying:
                product = arguments[i].gradient[:, None] * arguments[j].gradient
                if i != j:
                    product = product + product.swapaxes(0, 1)
                hessian = hessian + partial * product
        return Taylor(ufunc(*values), gradient, hessian)


def _power(x: Any, p: Any) -> Partials:
    def term(factor: Any, exponent: Any) -> Any:
        # Not 0/0, for instance of x**1 at 0.
        return np.where(factor == 0, 0.0, factor * np.power(x, exponent))

    value, log = np.power(x, p), np.log(x)
    mixed = np.power(x, p - 1) * (1 + p * log)
    return [term(p, p - 1), value * log], {
        (0, 0): term(p * (p - 1), p - 2),
        (0, 1): mixed,
        (1, 1): value * log**2,
    }


def _arctan2(y: Any, x: Any) -> Partials:
    r2 = x**2 + y**2
    bend = 2 * x * y / r2**2
    return [x / r2, -y / r2], {(0, 0): -bend, (0, 1): (y**2 - x**2) / r2**2, (1, 1): bend}


def _tan(x: Any) -> Partials:
    t = np.tan(x)
    return [1 + t**2], {(0, 0): 2 * t * (1 + t**2)}


PARTIALS: dict[np.ufunc, Callable[..., Partials]] = {
    np.add: lambda x, y: ([1.0, 1.0], {}),
    np.subtract: lambda x, y: ([1.0, -1.0], {}),
    np.multiply: lambda x, y: ([y, x], {(0, 1): 1.0}),
    np.divide: lambda x, y: ([1 / y, -x / y**2], {(0, 1): -1 / y**2, (1, 1): 2 * x / y**3}),
    np.power: _power,
    np.positive: lambda x: ([1.0], {}),
    np.negative: lambda x: ([-1.0], {}),
    np.sin: lambda x: ([np.cos(x)], {(0, 0): -np.sin(x)}),
    np.cos: lambda x: ([-np.sin(x)], {(0, 0): -np.cos(x)}),
    np.tan: _tan,
    np.exp: lambda x: ([np.exp(x)], {(0, 0): np.exp(x)}),
    np.log: lambda x: ([1 / x], {(0, 0): -1 / x**2}),
    np.sqrt: lambda x: ([0.5 / np.sqrt(x)], {(0, 0): -0.25 / (x * np.sqrt(x))}),
    np.abs: lambda x: ([np.sign(x)], {}),
    np.sign: lambda x: ([0.0], {}),
    np.arctan2: _arctan2,
}


FUNCTIONS = {
    name: getattr(np, name)
    for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "abs", "sign", "arctan2")
}
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
_ALLOWED = (
    *(ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Load, ast.Constant),
    *_OPERATORS,
)
# A step of a stack machine: a function with its number of arguments, a number, or a name.
_Step = tuple[Callable[..., Any], int] | np.float64 | str

# A function, the numbers of its arguments, and of values that are not used after it.
_Operation = tuple[Callable[..., Any], tuple[int, ...], tuple[int, ...]]
_Program = list[_Operation | np.float64 | str]


@dataclass(frozen=True)
class FormulaFunction:
    """A formula as a function of x, y, z (in lengths of R)."""

    steps: _Program

    def __call__(self, x: Array, y: Array, z: Array) -> Array:
        return np.broadcast_to(
            np.asarray(_evaluate(self.steps, x, y, z), dtype=np.float64), x.shape
        )

    def bounds(self, low: Array, high: Array) -> tuple[Array, Array, Array]:
        """Return bounds of the formula in boxes between corners (n, 3).

        Returns
        -------
        tuple
            (n,) each: a least and a largest value, and the variation of the derivatives within a
            box times its sides, summed.
        """
        enclosure, n = _evaluate(self.steps, *Enclosure.coordinates(low, high)), len(low)
        if not isinstance(enclosure, Enclosure):
            return np.full(n, enclosure), np.full(n, enclosure), np.zeros(n)
        sides = 2 * enclosure.halves
        widths = (slope.high - slope.low for slope in enclosure.slopes)
        variation = sum(
            np.where(side > 0, width * side, 0.0) for width, side in zip(widths, sides, strict=True)
        )
        least, largest = np.broadcast_arrays(enclosure.values.low, enclosure.values.high)
        return least, largest, np.broadcast_to(variation, n)


@dataclass(frozen=True)
class FormulaGroup:
    """Formulas of places in another frame and unit of length, with bounds between places.

    Attributes
    ----------
    frame
        Its axes, in the formulas' frame, are its rows; None if it is the same.
    """

    functions: Sequence[FormulaFunction]
    frame: Array | None = None
    length: float = 1.0

    def values(self, x: Array) -> Array:
        """Return the values (n, formulas) at places (n, 3)."""
        x = self.length * (x if self.frame is None else x @ self.frame)
        return np.stack([f(*x.T) for f in self.functions], axis=-1)

    def bounds(self, low: Array, high: Array) -> tuple[Array, ...]:
        """Return bounds (n, formulas) in boxes, see `FormulaFunction.bounds`."""
        if self.frame is not None:
            middle, half = (low + high) / 2 @ self.frame, (high - low) / 2 @ np.abs(self.frame)
            low, high = middle - half, middle + half
        bounds = [f.bounds(self.length * low, self.length * high) for f in self.functions]
        return tuple(np.stack(bound, axis=-1) for bound in zip(*bounds, strict=True))


def formula_group(
    functions: Sequence[object], frame: Array | None = None, length: float = 1.0
) -> FormulaGroup | None:
    """Return the group of those functions that are formulas; None without."""
    formulas = [f for f in functions if isinstance(f, FormulaFunction)]
    return FormulaGroup(formulas, frame, length) if formulas else None


def formula(text: str) -> FormulaFunction:
    """Return a function from text such as "z*sqrt(x**2 + y**2)".

    Raises
    ------
    ValueError
        If the text is anything but arithmetic of x, y, z, pi and the known functions.
    """
    return FormulaFunction(_parse(text))


def _checked(text: str) -> str:
    formula(text)
    return text


def _number_as_text(value: Any) -> Any:
    """Return a number as a formula."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return repr(value) if is_number else value


Formula = Annotated[
    str,
    BeforeValidator(_number_as_text, json_schema_input_type=str | float),
    AfterValidator(_checked),
    Field(examples=["z*sqrt(x**2 + y**2)"]),
]


def formula_with_derivatives(text: str) -> Callable[[Array], Taylor]:
    """Return a formula with its first and second derivatives, as a function of places (n, 3)."""
    steps = _parse(text)

    def evaluate(x: Array) -> Taylor:
        coordinates = Taylor.coordinates(x)
        value = _evaluate(steps, *coordinates)
        return value if isinstance(value, Taylor) else value + 0.0 * coordinates[0]  # a number

    return evaluate


def _parse(text: str) -> _Program:
    """Return the steps of a formula; raise a ValueError if it is none."""
    excerpt = text if len(text) <= 60 else f"{text[:57]}..."
    try:
        tree = ast.parse(text, mode="eval")
        nodes = list(ast.walk(tree))
    except (RecursionError, MemoryError):
        raise ValueError(
            f"{excerpt!r} is too long: allowed are some thousand terms in a row"
        ) from None
    except (SyntaxError, ValueError) as e:
        if "nested parentheses" in str(e):
            raise ValueError(f"{excerpt!r}: allowed are 200 brackets within each other") from None
        raise ValueError(f"{excerpt!r} is not a formula") from None
    called = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    for node in nodes:
        allowed = isinstance(node, _ALLOWED)
        if isinstance(node, ast.Constant):
            allowed = isinstance(node.value, int | float) and not isinstance(node.value, bool)
        if isinstance(node, ast.Name):
            allowed = node.id in (FUNCTIONS if id(node) in called else NAMES)
        if isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else ""
            allowed = (
                name in FUNCTIONS and not node.keywords and len(node.args) == FUNCTIONS[name].nin
            )
        if not allowed:
            raise ValueError(
                f"{excerpt!r}: allowed are numbers, {', '.join(NAMES)}, + - * / **, "
                f"{', '.join(FUNCTIONS)}"
            )
    return _without_repetition(_steps(tree))


def _without_repetition(steps: list[_Step]) -> _Program:
    """Return the steps with what is written several times computed once.

    Formulas of weights of points repeat themselves.
    """
    numbers, stack = dict[Any, int](), list[int]()
    unique_steps, operands = list[Any](), list[tuple[int, ...]]()
    for step in steps:
        arguments = tuple(stack[-step[1] :]) if isinstance(step, tuple) else ()
        stack = stack[: len(stack) - len(arguments)]
        key: Any = step
        if isinstance(step, tuple):
            key = step[0], arguments
        elif not isinstance(step, str):
            key = step.hex()  # 0.0 and -0.0 are not the same
        if key not in numbers:
            numbers[key] = len(unique_steps)
            unique_steps.append(step)
            operands.append(arguments)
        stack.append(numbers[key])
    last_use = {value: i for i, arguments in enumerate(operands) for value in arguments}
    program = _Program()
    for i, (step, arguments) in enumerate(zip(unique_steps, operands, strict=True)):
        if isinstance(step, tuple):
            unused = tuple(value for value in dict.fromkeys(arguments) if last_use[value] == i)
            program.append((step[0], arguments, unused))
        else:
            program.append(step)
    return program


def _evaluate(steps: _Program, x: Any, y: Any, z: Any) -> Any:
    names, values = {"x": x, "y": y, "z": z, "pi": np.float64(np.pi)}, list[Any]()
    with np.errstate(all="ignore"):
        for step in steps:
            if isinstance(step, tuple):
                function, arguments, unused = step
                values.append(function(*(values[i] for i in arguments)))
                for i in unused:
                    values[i] = None
            else:
                values.append(names[step] if isinstance(step, str) else step)
    return values[-1]


def symbolic(text: str, functions: Mapping[str, Callable[..., Any]], x: Any, y: Any, z: Any) -> Any:
    """Return a formula of symbols, with the functions that stand for those of `FUNCTIONS`."""
    formula(text)
    replacements = {FUNCTIONS[name]: functions[name] for name in FUNCTIONS}
    names, stack = {"x": x, "y": y, "z": z, "pi": float(np.pi)}, list[Any]()
    for step in _steps(ast.parse(text, mode="eval")):
        if isinstance(step, tuple):
            function, count = step
            stack[-count:] = [replacements.get(function, function)(*stack[-count:])]
        else:
            stack.append(names[step] if isinstance(step, str) else float(step))
    return stack[0]


def is_formula(text: str) -> bool:
    """Return whether a text is a formula."""
    try:
        formula(text)
    except ValueError:
        return False
    return True


def _steps(tree: ast.Expression) -> list[_Step]:
    """Return the steps of a stack machine that evaluates a formula.

    A sum of thousand terms is as many levels deep, too deep for recursion.

    Numbers are NumPy's: these neither grow without end, as 9**9**9 does, nor turn complex.
    """
    steps: list[_Step] = []
    pending: list[ast.AST] = [tree.body]
    # The last operation first, and of its values the last first; then all backwards.
    while pending:
        node = pending.pop()
        if isinstance(node, ast.BinOp):
            steps.append((_OPERATORS[type(node.op)], 2))
            pending += [node.left, node.right]
        elif isinstance(node, ast.UnaryOp):
            steps.append((_OPERATORS[type(node.op)], 1))
            pending.append(node.operand)
        elif isinstance(node, ast.Call):
            assert isinstance(node.func, ast.Name)
            steps.append((FUNCTIONS[node.func.id], len(node.args)))
            pending += node.args
        elif isinstance(node, ast.Name):
            steps.append(node.id)
        else:
            assert isinstance(node, ast.Constant)
            assert isinstance(node.value, int | float)
            steps.append(np.float64(min(node.value, sys.float_info.max)))
    return steps[::-1]


@dataclass(frozen=True)
class FormulaVectors:
    """Vectors of numbers and formulas of the undeformed place.

    Attributes
    ----------
    of_position
        Functions of x, y, z for each component.
    frame
        Axes of the formulas' frame, as columns.
    length
        R in the formulas' unit of length.
    vectors
        Whether components are those of a vector in the formulas' frame.
    """

    by_formula: ClassVar[bool] = True
    of_position: Sequence[Callable[[Array, Array, Array], Array]]
    frame: Array
    length: float
    factor: float = 1.0
    vectors: bool = False

    def __call__(self, r0: Array, n0: Array) -> Array:
        x = np.moveaxis(self.length * r0 @ self.frame, -1, 0)
        values = self.factor * np.stack([f(*x) for f in self.of_position], axis=-1)
        return values @ self.frame.T if self.vectors else values

    @property
    def formulas(self) -> FormulaGroup | None:
        return formula_group(self.of_position, self.frame, self.length)


@dataclass(frozen=True)
class InwardPressure:
    """A traction from a pressure by formula, which acts against the normal."""

    by_formula: ClassVar[bool] = True
    pressure: FormulaVectors

    def __call__(self, r0: Array, n0: Array) -> Array:
        return -self.pressure(r0, n0) * n0

    @property
    def formulas(self) -> FormulaGroup | None:
        return self.pressure.formulas


def formula_function(value: float | str) -> Callable[[Array, Array, Array], Array]:
    """Return a function of x, y, z from a formula, or from a number that is the same everywhere."""
    if isinstance(value, str):
        return formula(value)
    return lambda x, y, z: np.full_like(x, value)


@dataclass(frozen=True)
class FormulasInSpace:
    """A field in space from three formulas of the deformed place; a `FieldInSpace`.

    Attributes
    ----------
    components
        The formulas with their derivatives.
    axes
        Axes of the formulas' frame, as rows.
    """

    components: list[Callable[[Array], Taylor]]
    axes: Array

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        parts, Q = [component(x @ self.axes) for component in self.components], self.axes
        B, G, H = (
            np.stack([getattr(f, d) for f in parts]) for d in ("value", "gradient", "hessian")
        )
        return (
            np.einsum("ai,in->na", Q, B),
            np.einsum("ai,bj,ijn->nab", Q, Q, G, optimize=True),
            np.einsum("ai,bj,ck,ijkn->nabc", Q, Q, Q, H, optimize=True),
        )
