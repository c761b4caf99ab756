"""Formulas of a case: read, checked and evaluated, with their derivatives by Taylor's arithmetic."""

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

from magshell_fenicsx.input.enclosure import Enclosed

Array = NDArray[np.float64]
Partials = tuple[
    list[Any], dict[tuple[int, int], Any]
]  # first derivatives by each argument, second ones by pairs i <= j


@dataclass(frozen=True)
class Taylor(NDArrayOperatorsMixin):
    """What NumPy's functions of it return too.

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
        """x, y and z at places (n, 3)."""
        one, none = np.ones(len(x)), np.zeros((3, 3, len(x)))
        return [cls(x[:, i], np.eye(3)[i, :, None] * one, none) for i in range(3)]

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
        """A function of this and of numbers, by the chain rule."""
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
                hessian = hessian + partial * (
                    product if i == j else product + product.swapaxes(0, 1)
                )
        return Taylor(ufunc(*values), gradient, hessian)


def _power(x: Any, p: Any) -> Partials:
    def term(factor: Any, exponent: Any) -> Any:
        return np.where(
            factor == 0, 0.0, factor * np.power(x, exponent)
        )  # not 0/0, of x**1 at 0 for instance

    value, log = np.power(x, p), np.log(x)
    mixed = np.power(x, p - 1) * (1 + p * log)
    return [term(p, p - 1), value * log], {
        (0, 0): term(p * (p - 1), p - 2),
        (0, 1): mixed,
        (1, 1): value * log**2,
    }


def _arctan2(y: Any, x: Any) -> Partials:
    r2 = x**2 + y**2
    across = 2 * x * y / r2**2
    return [x / r2, -y / r2], {(0, 0): -across, (0, 1): (y**2 - x**2) / r2**2, (1, 1): across}


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
_Step = (
    tuple[Callable[..., Any], int] | np.float64 | str
)  # of a stack: a function of some values, a number, a name
_Operation = tuple[
    Callable[..., Any], tuple[int, ...], tuple[int, ...]
]  # of which values, and which are then not used
_Program = list[_Operation | np.float64 | str]


@dataclass(frozen=True)
class Read:
    """A formula as a function of x, y, z (in lengths of R)."""

    steps: _Program

    def __call__(self, x: Array, y: Array, z: Array) -> Array:
        return np.broadcast_to(
            np.asarray(_evaluate(self.steps, x, y, z), dtype=np.float64), x.shape
        )

    def bounds(self, low: Array, high: Array) -> tuple[Array, Array, Array]:
        """In boxes between corners (n, 3) a least and a largest value, and by how much f's
        derivatives differ (n,).

        The latter times the sides, summed.
        """
        enclosed, n = _evaluate(self.steps, *Enclosed.coordinates(low, high)), len(low)
        if not isinstance(enclosed, Enclosed):
            return np.full(n, enclosed), np.full(n, enclosed), np.zeros(n)
        sides, widths = 2 * enclosed.halves, (slope.high - slope.low for slope in enclosed.slopes)
        bent = sum(
            np.where(side > 0, width * side, 0.0) for width, side in zip(widths, sides, strict=True)
        )
        return (
            *np.broadcast_arrays(enclosed.values.low, enclosed.values.high),
            np.broadcast_to(bent, n),
        )  # type: ignore[return-value]


@dataclass(frozen=True)
class Together:
    """Formulas of places in another frame and unit of length, for what they may have between
    places.

    Attributes
    ----------
    frame
        Its axes, in the formulas' frame, are its rows; None if it is the same.
    """

    functions: Sequence[Read]
    frame: Array | None = None
    length: float = 1.0

    def values(self, x: Array) -> Array:
        """Of places (n, 3): (n, formulas)."""
        x = self.length * (x if self.frame is None else x @ self.frame)
        return np.stack([f(*x.T) for f in self.functions], axis=-1)

    def bounds(self, low: Array, high: Array) -> tuple[Array, ...]:
        """Of each (n, formulas), see `Read.bounds`."""
        if self.frame is not None:
            middle, half = (low + high) / 2 @ self.frame, (high - low) / 2 @ np.abs(self.frame)
            low, high = middle - half, middle + half
        of_formulas = [f.bounds(self.length * low, self.length * high) for f in self.functions]
        return tuple(np.stack(each, axis=-1) for each in zip(*of_formulas, strict=True))


def together(
    functions: Sequence[object], frame: Array | None = None, length: float = 1.0
) -> Together | None:
    """Those of some functions that are formulas; None without."""
    readable = [f for f in functions if isinstance(f, Read)]
    return Together(readable, frame, length) if readable else None


def formula(text: str) -> Read:
    """A function from text such as "z*sqrt(x**2 + y**2)".

    Raises
    ------
    ValueError
        If the text is anything but arithmetic of x, y, z, pi and the known functions.
    """
    return Read(_read(text))


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
        value = _evaluate(steps, *coordinates)
        return value if isinstance(value, Taylor) else value + 0.0 * coordinates[0]  # a number

    return evaluate


def _read(text: str) -> _Program:
    said = text if len(text) <= 60 else f"{text[:57]}..."
    try:
        tree = ast.parse(text, mode="eval")
        nodes = list(ast.walk(tree))
    except (RecursionError, MemoryError):
        raise ValueError(
            f"{said!r} is too long: allowed are some thousand terms in a row"
        ) from None
    except (SyntaxError, ValueError) as e:
        if "nested parentheses" in str(e):
            raise ValueError(f"{said!r}: allowed are 200 brackets within each other") from None
        raise ValueError(f"{said!r} is not a formula") from None
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
                f"{said!r}: allowed are numbers, {', '.join(NAMES)}, + - * / **, {', '.join(FUNCTIONS)}"
            )
    return _once(_steps(tree))


def _once(steps: list[_Step]) -> _Program:
    """The steps with what is written several times computed once, as the weights of points are."""
    numbers, stack, operands = dict[Any, int](), list[int](), list[tuple[int, ...]]()
    made = list[Any]()
    for step in steps:
        of = tuple(stack[-step[1] :]) if isinstance(step, tuple) else ()
        stack = stack[: len(stack) - len(of)]
        key = (
            (step[0], of)
            if isinstance(step, tuple)
            else step
            if isinstance(step, str)
            else step.hex()
        )
        if key not in numbers:  # 0.0 and -0.0 are not the same
            numbers[key] = len(made)
            made.append(step)
            operands.append(of)
        stack.append(numbers[key])
    last = {value: i for i, of in enumerate(operands) for value in of}
    no_more = [
        tuple(value for value in dict.fromkeys(of) if last[value] == i)
        for i, of in enumerate(operands)
    ]
    each = zip(made, operands, no_more, strict=True)
    return [(step[0], of, then) if isinstance(step, tuple) else step for step, of, then in each]


def _evaluate(steps: _Program, x: Any, y: Any, z: Any) -> Any:
    names, values = {"x": x, "y": y, "z": z, "pi": np.float64(np.pi)}, list[Any]()
    with np.errstate(all="ignore"):
        for step in steps:
            if isinstance(step, tuple):
                function, of, no_more = step
                values.append(function(*(values[i] for i in of)))
                for i in no_more:
                    values[i] = None
            else:
                values.append(names[step] if isinstance(step, str) else step)
    return values[-1]


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
    """What a stack does in turn: a sum of thousand terms is as many levels deep, too deep for
    recursion.

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


@dataclass(frozen=True)
class ByFormula:
    """Vectors of numbers and formulas of the undeformed place, in a frame and a unit of length of
    their own.
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
    def formulas(self) -> Together | None:
        return together(self.of_position, self.frame, self.length)


@dataclass(frozen=True)
class Inwards:
    """A pressure by formula, which is against the normal."""

    by_formula: ClassVar[bool] = True
    pressure: ByFormula

    def __call__(self, r0: Array, n0: Array) -> Array:
        return -self.pressure(r0, n0) * n0

    @property
    def formulas(self) -> Together | None:
        return self.pressure.formulas


def function(value: float | str) -> Callable[[Array, Array, Array], Array]:
    """A formula of x, y, z, or a number that is the same everywhere."""
    if isinstance(value, str):
        return formula(value)
    return lambda x, y, z: np.full_like(x, value)


@dataclass(frozen=True)
class FormulasInSpace:
    """Three formulas of the deformed place as a `FieldInSpace`, in a frame whose axes are the rows
    of `axes`.
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
