"""Formulas of a case: parsed, checked and evaluated, with derivatives by Taylor arithmetic.

The text of a formula becomes steps of a stack machine, which pushes numbers and names and replaces
the top values by a function of them; then a program, in which each repeated part stands once.
Programs run on arrays, on `Taylor` objects (a value with its first and second derivatives), and on
enclosures (bounds of all values in a box). Frames are given by rotation matrices Q. R is the
reference length, over which a model measures places.
"""

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
        """Return the functions x, y and z at places (n, 3), with their derivatives."""
        ones, zeros = np.ones(len(x)), np.zeros((3, 3, len(x)))
        return [cls(x[:, i], np.eye(3)[i, :, None] * ones, zeros) for i in range(3)]

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
        """Return a NumPy function of this and other arguments, with derivatives by the chain rule.

        NumPy calls it for each of its functions. Arguments are `Taylor` objects or numbers.
        Functions without an entry in `PARTIALS` are not implemented.
        """
        is_plain_call = method == "__call__" and not options
        if not is_plain_call or ufunc not in PARTIALS:
            return NotImplemented
        # derivatives of the function by its arguments, and those arguments that have derivatives
        values = [a.value if isinstance(a, Taylor) else a for a in arguments]
        first_partials, second_partials = PARTIALS[ufunc](*values)
        positions = [i for i, a in enumerate(arguments) if isinstance(a, Taylor)]
        # first derivatives by the arguments times the derivatives of these
        gradient, hessian = np.zeros_like(self.gradient), np.zeros_like(self.hessian)
        for i in positions:
            gradient = gradient + first_partials[i] * arguments[i].gradient
            hessian = hessian + first_partials[i] * arguments[i].hessian
        # second derivatives by pairs of arguments times the products of their gradients
        for (i, j), partial in second_partials.items():
            if i in positions and j in positions:
                product = arguments[i].gradient[:, None] * arguments[j].gradient
                if i != j:  # the pair (j, i) too
                    product = product + product.swapaxes(0, 1)
                hessian = hessian + partial * product
        return Taylor(ufunc(*values), gradient, hessian)


def _power(x: Any, p: Any) -> Partials:
    """Return the first and second derivatives of x**p by both arguments."""

    def term(factor: Any, exponent: Any) -> Any:
        """Return factor x**exponent."""
        # at x = 0 the power may be infinite: with a factor of 0 the term is 0, not nan
        return np.where(factor == 0, 0.0, factor * np.power(x, exponent))

    value, log = np.power(x, p), np.log(x)
    mixed = np.power(x, p - 1) * (1 + p * log)
    return [term(p, p - 1), value * log], {
        (0, 0): term(p * (p - 1), p - 2),
        (0, 1): mixed,
        (1, 1): value * log**2,
    }


def _arctan2(y: Any, x: Any) -> Partials:
    """Return the first and second derivatives of arctan2(y, x) by both arguments."""
    r2 = x**2 + y**2
    mixed_part = 2 * x * y / r2**2
    return [x / r2, -y / r2], {
        (0, 0): -mixed_part,
        (0, 1): (y**2 - x**2) / r2**2,
        (1, 1): mixed_part,
    }


def _tan(x: Any) -> Partials:
    """Return the first and second derivative of tan x."""
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
    """A formula of the case as a function of x, y, z, in the case's unit of length.

    Attributes
    ----------
    steps
        The program that evaluates the formula: step i makes value i from a number, a name, or a
        function of earlier values.
    """

    steps: _Program

    def __call__(self, x: Array, y: Array, z: Array) -> Array:
        return np.broadcast_to(
            np.asarray(_evaluate(self.steps, x, y, z), dtype=np.float64), x.shape
        )

    def bounds(self, low: Array, high: Array) -> tuple[Array, Array, Array]:
        """Return bounds of the formula in boxes between corners `low` and `high`, (n, 3) each.

        Returns
        -------
        least, largest
            (n,) each: the formula's values in a box lie between them.
        variation
            (n,) bound of the variation of the first derivatives within a box, each times the side
            of the box, summed.
        """
        # in each box the interval of all values, and the intervals of the slopes by x, y and z; a
        # formula without a variable is a number
        enclosure, n = _evaluate(self.steps, *Enclosure.coordinates(low, high)), len(low)
        if not isinstance(enclosure, Enclosure):
            return np.full(n, enclosure), np.full(n, enclosure), np.zeros(n)
        sides = 2 * enclosure.halves
        widths = (slope.high - slope.low for slope in enclosure.slopes)
        variation = sum(
            np.where(side > 0, width * side, 0.0)  # not 0 times infinity
            for width, side in zip(widths, sides, strict=True)
        )
        least, largest = np.broadcast_arrays(enclosure.values.low, enclosure.values.high)
        return least, largest, np.broadcast_to(variation, n)


@dataclass(frozen=True)
class FormulaGroup:
    """Formulas of places in another frame and unit of length, with bounds between places.

    Attributes
    ----------
    functions
        The formulas.
    frame
        Rotation (3, 3): the axes of the frame of the places, in the formulas' frame, are its rows.
        None if the frames are the same.
    length
        Unit of the places in the formulas' unit of length.
    """

    functions: Sequence[FormulaFunction]
    frame: Array | None = None
    length: float = 1.0

    def values(self, x: Array) -> Array:
        """Return the values (n, formulas) at places (n, 3)."""
        x = self.length * (x if self.frame is None else x @ self.frame)
        return np.stack([f(*x.T) for f in self.functions], axis=-1)

    def bounds(self, low: Array, high: Array) -> tuple[Array, ...]:
        """Return least values, largest values and variations, (n, formulas) each, in boxes.

        A variation bounds by how much the first derivatives vary within a box, times its sides. The
        boxes lie between corners (n, 3). If the formulas have another frame, boxes along its axes
        that contain them take their place.
        """
        # in another frame: the box along the formulas' axes that contains the rotated box
        if self.frame is not None:
            middle, half = (low + high) / 2 @ self.frame, (high - low) / 2 @ np.abs(self.frame)
            low, high = middle - half, middle + half
        bounds = [f.bounds(self.length * low, self.length * high) for f in self.functions]
        return tuple(np.stack(bound, axis=-1) for bound in zip(*bounds, strict=True))


def formula_group(
    functions: Sequence[object], frame: Array | None = None, length: float = 1.0
) -> FormulaGroup | None:
    """Return the group of those of some functions that are formulas of a case; None without any.

    Parameters
    ----------
    frame
        Rotation (3, 3) whose rows are the axes of the frame of the places, in the formulas' frame;
        None if the frames are the same.
    length
        Unit of the places in the formulas' unit of length.
    """
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
    """Return a text that is a formula; raise a ValueError if not."""
    formula(text)
    return text


def _number_as_text(value: Any) -> Any:
    """Return a number as the text of a formula, and any other value unchanged."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return repr(value) if is_number else value


Formula = Annotated[
    str,
    BeforeValidator(_number_as_text, json_schema_input_type=str | float),
    AfterValidator(_checked),
    Field(examples=["z*sqrt(x**2 + y**2)"]),
]


def formula_with_derivatives(text: str) -> Callable[[Array], Taylor]:
    """Return a formula as a function of places (n, 3), with its first and second derivatives."""
    steps = _parse(text)

    def evaluate(x: Array) -> Taylor:
        coordinates = Taylor.coordinates(x)
        value = _evaluate(steps, *coordinates)
        # a formula without a variable is a number: it gets derivatives of zero
        return value if isinstance(value, Taylor) else value + 0.0 * coordinates[0]

    return evaluate


def _parse(text: str) -> _Program:
    """Return the program of a formula, with each repeated part computed once.

    Raises
    ------
    ValueError
        If the text is no formula, or too long or too deeply nested.
    """
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
    # what is called must be a function, and all other names must not
    called_names = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    for node in nodes:
        if not _is_allowed(node, is_called=id(node) in called_names):
            raise ValueError(
                f"{excerpt!r}: allowed are numbers, {', '.join(NAMES)}, + - * / **, "
                f"{', '.join(FUNCTIONS)}"
            )
    return _without_repetition(_steps(tree))


def _is_allowed(node: ast.AST, *, is_called: bool) -> bool:
    """Return whether a formula may have a node; `is_called` is whether a call has it as function.

    Allowed are numbers, x, y, z and pi, operators, and calls of known functions with as many
    arguments as they take.
    """
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.Name):
        return node.id in (FUNCTIONS if is_called else NAMES)
    if isinstance(node, ast.Call):
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in FUNCTIONS or node.keywords:
            return False
        # nin: the number of arguments of NumPy's function
        return bool(len(node.args) == FUNCTIONS[name].nin)
    return isinstance(node, _ALLOWED)


def _without_repetition(steps: list[_Step]) -> _Program:
    """Return a program that computes repeated parts of a formula once.

    Formulas that are made of many weighted points, for example, repeat the same parts.

    Parameters
    ----------
    steps
        Steps of a stack machine: a function with its number of arguments, a number, or a name.

    Returns
    -------
    _Program
        Its step i makes value i: from a number, a name, or a function of earlier values by their
        numbers. A function also lists the values that no later step uses, to free their memory.
    """
    # what makes a value -> its number; and the numbers of the values on the stack
    number_of_value, value_stack = dict[Any, int](), list[int]()
    # the steps that make new values, each with the numbers of its arguments
    unique_steps, operands = list[Any](), list[tuple[int, ...]]()
    for step in steps:
        # the arguments of a function are taken from the stack
        arguments: tuple[int, ...] = ()
        key: Any = step
        if isinstance(step, tuple):
            function, count = step
            arguments = tuple(value_stack[-count:])
            value_stack = value_stack[: len(value_stack) - count]
            key = function, arguments
        elif not isinstance(step, str):
            key = step.hex()  # 0.0 and -0.0 are not the same
        # a step with the same key has made the same value before
        if key not in number_of_value:
            number_of_value[key] = len(unique_steps)
            unique_steps.append(step)
            operands.append(arguments)
        value_stack.append(number_of_value[key])
    # value -> the last step that uses it: later entries of the mapping replace earlier ones
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
    """Return the value of a program at x, y, z, which are arrays, `Taylor` functions or enclosures.

    The type of the result is theirs; it is a number if the formula has no variable.
    """
    names, values = {"x": x, "y": y, "z": z, "pi": np.float64(np.pi)}, list[Any]()
    with np.errstate(all="ignore"):  # values that are not finite are refused later, with a place
        for step in steps:
            if isinstance(step, tuple):
                function, arguments, unused = step
                values.append(function(*(values[i] for i in arguments)))
                for i in unused:
                    values[i] = None  # frees the memory of an array
            else:
                values.append(names[step] if isinstance(step, str) else step)
    return values[-1]


def symbolic(text: str, functions: Mapping[str, Callable[..., Any]], x: Any, y: Any, z: Any) -> Any:
    """Return a formula of the symbols x, y, z, such as symbols of UFL.

    Parameters
    ----------
    functions
        Name -> function of symbols that stands for the one of the same name in `FUNCTIONS`.

    Raises
    ------
    ValueError
        If the text is no formula.
    """
    formula(text)  # raises if it is none
    replacements = {FUNCTIONS[name]: functions[name] for name in FUNCTIONS}
    names, stack = {"x": x, "y": y, "z": z, "pi": float(np.pi)}, list[Any]()
    for step in _steps(ast.parse(text, mode="eval")):
        if isinstance(step, tuple):
            # the value of the function replaces its arguments on the stack; operators have no
            # replacement: symbols know them
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

    A step is a function with its number of arguments, a number, or a name. There is no recursion,
    because a sum of a thousand terms is a thousand levels deep. Numbers are those of NumPy: these
    neither grow without end, as 9**9**9 does, nor turn complex.
    """
    steps: list[_Step] = []
    pending: list[ast.AST] = [tree.body]
    # The tree is walked backwards: each operation comes before its values, and the last value
    # first. The reversed result has what a stack machine needs: the values, then their operation.
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
    factor
        Factor of all values.
    vectors
        Whether components are those of a vector in the formulas' frame.
    by_formula
        Always true: cells get polynomials with the moments of the formulas, not values at nodes.
    formulas
        Those of the components that are formulas of a case, with the frame and unit of the places.
    """

    by_formula: ClassVar[bool] = True
    of_position: Sequence[Callable[[Array, Array, Array], Array]]
    frame: Array
    length: float
    factor: float = 1.0
    vectors: bool = False

    def __call__(self, r0: Array, n0: Array) -> Array:
        """Return the vectors (..., components) at places (..., 3) over R; `n0` is not used."""
        x = np.moveaxis(self.length * r0 @ self.frame, -1, 0)
        values = self.factor * np.stack([f(*x) for f in self.of_position], axis=-1)
        return values @ self.frame.T if self.vectors else values

    @property
    def formulas(self) -> FormulaGroup | None:
        return formula_group(self.of_position, self.frame, self.length)


@dataclass(frozen=True)
class InwardPressure:
    """A traction from a pressure by formula, which acts against the normal.

    Attributes
    ----------
    pressure
        The pressure, as a vector of one component.
    by_formula, formulas
        As of `pressure`: always true, and the formulas in it with their frame and unit of length.
    """

    by_formula: ClassVar[bool] = True
    pressure: FormulaVectors

    def __call__(self, r0: Array, n0: Array) -> Array:
        """Return the tractions (..., 3) at places and outward unit normals (..., 3)."""
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
        """Return the field (n, 3), its gradient (n, 3, 3) and second derivatives (n, 3, 3, 3).

        Places `x` (n, 3) are in the formulas' unit of length; the first index is the component.
        """
        # value (3, n), gradient (3, 3, n) and second derivatives (3, 3, 3, n) of the components
        taylors, Q = [component(x @ self.axes) for component in self.components], self.axes
        B = np.stack([f.value for f in taylors])
        G = np.stack([f.gradient for f in taylors])
        H = np.stack([f.hessian for f in taylors])
        # from the formulas' frame to that of the places: each index is turned by Q
        return (
            np.einsum("ai,in->na", Q, B),
            np.einsum("ai,bj,ijn->nab", Q, Q, G, optimize=True),
            np.einsum("ai,bj,ck,ijkn->nabc", Q, Q, Q, H, optimize=True),
        )
