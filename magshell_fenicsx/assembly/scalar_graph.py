"""An expression of UFL as a graph of operations on scalars, and its derivatives.

Each operation occurs once. A node is the number of an operation; the operands of a node have
smaller numbers. Inputs are the components of fields and constants. Theory: docs/tangent.md.

A node that is simplified may be another one than the operation asked for, such as a for a + 0. A
derivative is a node too; one that is missing is zero.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations_with_replacement
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ufl import classes
from ufl.algorithms.analysis import has_type
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals, unique_post_traversal

Nodes = NDArray[np.int64]
FirstDerivatives = dict[int, int]  # operand or input -> derivative
SecondDerivatives = dict[tuple[int, int], int]  # two of them, the smaller one first -> derivative

# Its name, then the operands' nodes; of an input or a number what it is.
Operation = tuple[Any, ...]

COMPARISONS = {  # and logical operations, with their names in C
    classes.LT: "<",
    classes.GT: ">",
    classes.LE: "<=",
    classes.GE: ">=",
    classes.EQ: "==",
    classes.NE: "!=",
}
COMPARISONS |= {classes.AndCondition: "&", classes.OrCondition: "|"}
MAX_PRODUCT_POWER = 4.5  # exponent up to which a power is written as a product
IDENTITY_OPERATIONS = (classes.Variable, classes.Real, classes.Conj)  # all numbers are real


class ScalarGraph:
    """A graph of operations on scalars; a node is the number of an operation.

    Attributes
    ----------
    operations
        The operation of each node: its name, then the nodes of its operands. Names are those of C,
        and "pick" (condition, value if it holds, other value). Without operands are "number"
        (value), "field" (position among the fields, component) and "constant" (position among the
        values of all constants).
    zero, one
        The nodes of these numbers.

    The private field `_nodes` has the node of each operation.
    """

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self._nodes: dict[Operation, int] = {}
        self.zero, self.one = self.number(0.0), self.number(1.0)

    def node(self, *operation: Any) -> int:
        """Return the node of an operation, a new one if the operation is new."""
        node = self._nodes.get(operation)
        if node is None:
            node = self._nodes[operation] = len(self.operations)
            self.operations.append(operation)
        return node

    def number(self, value: float) -> int:
        """Return the node of a number."""
        return self.node("number", float(value))

    def value(self, node: int) -> float | None:
        """Return the value of a number's node; None for other nodes."""
        operation = self.operations[node]
        return operation[1] if operation[0] == "number" else None

    def add(self, a: int, b: int) -> int:
        """Return the node of a + b, simplified; the smaller node becomes the first operand."""
        if a == self.zero or b == self.zero:
            return b if a == self.zero else a
        if a == b:
            return self.times(self.number(2.0), a)
        x, y = self.value(a), self.value(b)
        if x is not None and y is not None:
            return self.number(x + y)
        return self.node("+", min(a, b), max(a, b))

    def times(self, a: int, b: int) -> int:
        """Return the node of a b, simplified; a number becomes the first factor."""
        if self.zero in (a, b):
            return self.zero
        if a == self.one or b == self.one:
            return b if a == self.one else a
        x, y = self.value(a), self.value(b)
        if x is not None and y is not None:
            return self.number(x * y)
        if y is not None:
            a, b, x = b, a, y
        if x is not None:
            # two numbers in a product become one
            name, *factors = self.operations[b]
            if name == "*" and (number_in_b := self.value(factors[0])) is not None:
                return self.times(self.number(x * number_in_b), factors[1])
            return self.node("*", a, b)
        return self.node("*", min(a, b), max(a, b))

    def minus(self, a: int) -> int:
        """Return the node of -a, simplified."""
        return self.times(self.number(-1.0), a)

    def divide(self, a: int, b: int) -> int:
        """Return the node of a/b, simplified."""
        y = self.value(b)
        if y:
            return self.times(a, self.number(1 / y))
        return self.zero if a == self.zero else self.node("/", a, b)

    def power(self, a: int, b: int) -> int:
        """Return the node of a to the power b, simplified.

        Small whole and half powers are written as products and square roots.
        """
        exponent = self.value(b)
        if exponent is None:
            return self.node("pow", a, b)
        # neither a whole nor a half power, or too large
        if 2 * exponent != int(2 * exponent) or abs(exponent) > MAX_PRODUCT_POWER:
            return self.node("pow", a, b)
        product = self.one if exponent == int(exponent) else self.node("sqrt", a)
        for _ in range(int(abs(exponent))):
            product = self.times(product, a)
        return product if exponent >= 0 else self.divide(self.one, product)

    def pick(self, condition: int, a: int, b: int) -> int:
        """Return the node of a if a condition holds, else of b."""
        return a if a == b else self.node("pick", condition, a, b)

    def sum(self, nodes: Iterable[int]) -> int:
        """Return the node of the sum of nodes, simplified."""
        total = self.zero
        for node in nodes:
            total = self.add(total, node)
        return total

    def dependencies(self, nodes: Iterable[int]) -> list[int]:
        """Return the given nodes and all nodes on which they depend.

        Operands come first, each shortly before it is needed.
        """
        order, visited = list[int](), set[int]()
        # depth first; a node comes back as done after its operands
        stack = [(node, False) for node in reversed(list(nodes))]
        while stack:
            node, operands_done = stack.pop()
            if operands_done:
                order.append(node)
            elif node not in visited:
                visited.add(node)
                stack.append((node, True))
                for operand in reversed(self.operands(node)):
                    if operand not in visited:
                        stack.append((operand, False))
        return order

    def operands(self, node: int) -> tuple[int, ...]:
        """Return the nodes of an operation's operands; none for an input or a number."""
        name, *operand_nodes = self.operations[node]
        return () if name in ("number", "field", "constant") else tuple(operand_nodes)

    def substitute(self, nodes: Sequence[int], replacements: dict[int, int]) -> list[int]:
        """Return nodes of the same expressions with other inputs.

        Parameters
        ----------
        replacements
            Input -> the node that replaces it.
        """
        new_nodes = dict(replacements)
        # operands first, so that each operation is applied to known nodes
        for node in self.dependencies(nodes):
            if node in new_nodes:
                continue
            operands = self.operands(node)
            if operands:
                new_nodes[node] = self.apply(
                    self.operations[node][0], [new_nodes[o] for o in operands]
                )
            else:
                new_nodes[node] = node
        return [new_nodes[node] for node in nodes]

    def apply(self, name: str, operands: Sequence[int]) -> int:
        """Return the node of the operation `name` on some nodes, simplified."""
        simplified: dict[str, Callable[..., int]] = {
            "+": self.add,
            "*": self.times,
            "/": self.divide,
            "pow": self.power,
            "pick": self.pick,
        }
        return simplified[name](*operands) if name in simplified else self.node(name, *operands)

    # --- from UFL -----------------------------------------------------------------------------

    def components(
        self, expression: Expr, fields: Sequence[Any], constants: Sequence[Any]
    ) -> Nodes:
        """Return the nodes of an expression's components, in the shape of the expression.

        Parameters
        ----------
        expression
            An expression of UFL without free indices.
        fields, constants
            All that occur in it, in their order among the inputs.

        Raises
        ------
        NotImplementedError
            If the expression has more than arithmetic, conditions and functions of numbers.
        """
        lowered = apply_algebra_lowering(expression)
        if has_type(lowered, classes.Derivative):
            lowered = apply_derivatives(lowered)
        # the components of each field and constant, as operations without operands
        inputs: dict[Expr, list[Operation]] = {}
        for number, f in enumerate(fields):
            inputs[f] = [("field", number, k) for k in range(prod(f.ufl_shape))]
        constant_start = 0
        for c in constants:
            inputs[c] = [("constant", constant_start + k) for k in range(prod(c.ufl_shape))]
            constant_start += prod(c.ufl_shape)
        values: dict[Expr, Nodes] = {}
        for subexpression in unique_post_traversal(lowered):
            if subexpression in inputs:
                nodes = [self.node(*operation) for operation in inputs[subexpression]]
                values[subexpression] = np.array(nodes).reshape(subexpression.ufl_shape)
            elif not isinstance(subexpression, classes.MultiIndex | classes.Label):
                values[subexpression] = self._translate(
                    subexpression, [values.get(o) for o in subexpression.ufl_operands]
                )
        return values[lowered]

    def _translate(self, e: Expr, operands: list[Any]) -> Nodes:
        """Return the nodes of an expression e from those of its operands.

        Parameters
        ----------
        operands
            The nodes of each operand; None for a multi-index or label.

        Returns
        -------
        Nodes in the shape (*shape, *dimensions of the free indices) of the expression.
        """
        if isinstance(e, classes.Zero):
            return np.full(e.ufl_shape + e.ufl_index_dimensions, self.zero)
        if isinstance(e, classes.ScalarValue):
            return np.array(self.number(float(e)))
        if isinstance(e, classes.Identity):
            return np.where(np.eye(*e.ufl_shape) == 1, self.one, self.zero)
        if isinstance(e, IDENTITY_OPERATIONS):
            return np.asarray(operands[0])
        if isinstance(e, classes.Indexed):
            return _indexed(operands[0], e)
        if isinstance(e, classes.ComponentTensor):
            return _component_tensor(operands[0], e)
        if isinstance(e, classes.ListTensor):
            return np.stack(operands)
        if isinstance(e, classes.IndexSum):
            return self._index_sum(operands[0], e)
        # any other expression is an operation on numbers, component by component
        operation = self._scalar_operation(e)
        pairs = zip(operands, e.ufl_operands, strict=True)
        aligned = [_aligned(nodes, operand, e) for nodes, operand in pairs if nodes is not None]
        arrays = np.broadcast_arrays(*aligned)
        # a row of operands for each component of the result
        rows = np.stack([nodes.ravel() for nodes in arrays], axis=1).tolist()
        return np.array([operation(*row) for row in rows]).reshape(arrays[0].shape)

    def _index_sum(self, value: Nodes, e: Expr) -> Nodes:
        """Return the nodes of a sum over a free index of A.

        Parameters
        ----------
        value
            Nodes (*shape, *free indices) of A.
        e
            The sum.
        """
        tensor, (index,) = e.ufl_operands
        axis = len(tensor.ufl_shape) + tensor.ufl_free_indices.index(index.count())
        # the summed index becomes the last axis
        summands = np.moveaxis(value, axis, -1)
        sums = [self.sum(flat(row)) for row in summands.reshape(-1, summands.shape[-1])]
        return np.array(sums).reshape(summands.shape[:-1])

    def _scalar_operation(self, e: Expr) -> Callable[..., int]:
        """Return the function from operand nodes to a node that an expression applies by component.

        Raises
        ------
        NotImplementedError
            If the expression is no operation on numbers.
        """
        if type(e) in (simple := self._simple_operations()):
            return simple[type(e)]
        if type(e) in COMPARISONS:
            name = COMPARISONS[type(e)]
            return lambda a, b: self.node(name, a, b)
        if isinstance(e, classes.MathFunction):
            name = {"ln": "log"}.get(e._name, e._name)  # names in C
            return lambda a: self.node(name, a)
        if isinstance(e, classes.BesselJ | classes.BesselY):
            name = "jn" if isinstance(e, classes.BesselJ) else "yn"
            return lambda order, x: self.node(name, order, x)
        raise NotImplementedError(
            f"an energy at points has {type(e).__name__}, which is no function of numbers"
        )

    def _simple_operations(self) -> dict[type, Callable[..., int]]:
        """Return the classes of UFL expressions with one operation, and the operation of each."""
        return {
            classes.Sum: self.add,
            classes.Product: self.times,
            classes.Division: self.divide,
            classes.Power: self.power,
            classes.Conditional: self.pick,
            classes.Abs: lambda a: self.pick(self.node("<", a, self.zero), self.minus(a), a),
            classes.MinValue: lambda a, b: self.pick(self.node("<", a, b), a, b),
            classes.MaxValue: lambda a, b: self.pick(self.node(">", a, b), a, b),
            classes.NotCondition: lambda a: self.node("!", a),
            classes.Atan2: lambda a, b: self.node("atan2", a, b),
        }

    # --- derivatives --------------------------------------------------------------------------

    def derivatives(
        self, f: int, inputs: Sequence[int], *, second: bool
    ) -> tuple[FirstDerivatives, SecondDerivatives]:
        """Return the first derivatives of a node f by some inputs, and the second ones.

        Missing derivatives are zero. Nodes are eliminated from f down to the inputs, with the
        derivatives of f by those that are left: R. M. Gower and M. P. Mello, *A new framework for
        the computation of Hessians*, Optimization Methods and Software 27 (2012).

        Parameters
        ----------
        second
            Whether second derivatives are computed.

        Returns
        -------
        Input -> first derivative, and pair of inputs, the smaller one first -> second derivative.
        """
        ends = set(inputs)
        ascending = sorted(self.dependencies([f]))
        active = self._nodes_that_depend_on(ends, ascending)
        # derivatives of f by a node, and by two nodes (in both orders)
        adjoints, pairs = {f: self.one}, dict[int, dict[int, int]]()

        def couple(j: int, k: int, value: int) -> None:
            """Add a value to the second derivative of f by the nodes j and k."""
            if value != self.zero:
                total = self.add(pairs.setdefault(j, {}).get(k, self.zero), value)
                pairs[j][k] = pairs.setdefault(k, {})[j] = total

        for node in reversed(ascending):
            if node in ends or node not in active:
                continue
            # the node is eliminated: derivatives by it, by it and another one, and by it twice
            adjoint = adjoints.pop(node, self.zero)
            mixed = pairs.pop(node, {})
            squared = mixed.pop(node, self.zero)
            if adjoint == self.zero and squared == self.zero and not mixed:
                continue
            # derivatives of the node's operation by its operands
            slopes, curvatures = self._local_derivatives(node, active, ends, second=second)
            # second derivatives by the node and another one move to the operands: chain rule
            for other_node, value in mixed.items():
                pairs[other_node].pop(node)
                for j, slope in slopes.items():
                    # a pair of equal nodes stands for two mixed derivatives
                    multiplicity = self.number(2.0 if j == other_node else 1.0)
                    couple(j, other_node, self.times(multiplicity, self.times(slope, value)))
            # pairs of operands: from the second derivative by the node, and from its curvature
            for j, k in combinations_with_replacement(slopes, 2) if second else ():
                curvature = curvatures.get((min(j, k), max(j, k)), self.zero)
                curvature_part = self.times(adjoint, curvature)
                slope_part = self.times(slopes[j], self.times(slopes[k], squared))
                couple(j, k, self.add(slope_part, curvature_part))
            for j, slope in slopes.items():  # first derivatives move to the operands
                adjoints[j] = self.add(adjoints.get(j, self.zero), self.times(adjoint, slope))
        # of both orders of a pair one
        upper = {(j, k): value for j, row in pairs.items() for k, value in row.items() if j <= k}
        return {node: value for node, value in adjoints.items() if node in ends}, upper

    def _nodes_that_depend_on(self, inputs: set[int], nodes: Iterable[int]) -> set[int]:
        """Return the inputs, and those of some nodes that depend on one.

        Parameters
        ----------
        nodes
            Nodes in an order in which operands come first.
        """
        dependent = set(inputs)
        for node in nodes:
            if any(operand in dependent for operand in self.operands(node)):
                dependent.add(node)
        return dependent

    def _local_derivatives(
        self, node: int, active: set[int], ends: set[int], *, second: bool
    ) -> tuple[FirstDerivatives, SecondDerivatives]:
        """Return the first and second derivatives of an operation by its operands.

        A choice ("pick") is differentiated by the inputs instead, each side on its own. The side
        that is not picked may have no value, so it must not be multiplied by anything.

        Parameters
        ----------
        active
            Nodes that depend on inputs; others count as constant.
        ends
            The inputs.
        second
            Whether second derivatives are computed.
        """
        name, *operands = self.operations[node]
        if name == "pick":
            condition, *sides = operands
            # f where the condition holds, g elsewhere: first and second derivatives of both
            (f1, f2), (g1, g2) = (
                self.derivatives(side, list(ends), second=second) for side in sides
            )
            zero = self.zero
            return (
                {i: self.pick(condition, f1.get(i, zero), g1.get(i, zero)) for i in f1 | g1},
                {i: self.pick(condition, f2.get(i, zero), g2.get(i, zero)) for i in f2 | g2},
            )
        # the rules are by positions of operands; an operand that occurs twice gets the sum
        rule_slopes, rule_curvatures = self._rules(node, name, operands)
        slopes: FirstDerivatives = {}
        curvatures: SecondDerivatives = {}
        for i, operand in enumerate(operands):
            if operand not in active:
                continue
            slopes[operand] = self.add(slopes.get(operand, self.zero), rule_slopes[i])
            # each pair of nodes once, the smaller node first
            for k, other_operand in enumerate(operands if second else []):
                if other_operand >= operand and other_operand in active:
                    pair = operand, other_operand
                    curvature = curvatures.get(pair, self.zero)
                    curvatures[pair] = self.add(curvature, rule_curvatures[i][k])
        return slopes, curvatures

    def _rules(
        self, node: int, name: str, operands: list[int]
    ) -> tuple[list[int], list[list[int]]]:
        """Return the first and second derivatives of an operation by its operands, as nodes.

        The operands count as different and independent of each other.

        Parameters
        ----------
        node
            The node of the operation, whose value some derivatives contain.
        name, operands
            Its name and the nodes of its operands.

        Returns
        -------
        A list with an entry for each operand, and a matrix as nested lists.
        """
        zero, one, number = self.zero, self.one, self.number
        times, divide = self.times, self.divide
        a, b = operands[0], operands[-1]
        if name == "+":
            return [one, one], [[zero, zero], [zero, zero]]
        if name == "*":
            return [b, a], [[zero, one], [one, zero]]
        if name == "/":
            # 1/b and -(a/b)/b; by both -1/b^2, by b twice 2 (a/b)/b^2
            inverse, slope = divide(one, b), self.minus(divide(node, b))
            mixed = self.minus(times(inverse, inverse))
            return [inverse, slope], [
                [zero, mixed],
                [mixed, times(number(-2.0), times(slope, inverse))],
            ]
        if name == "pow":
            # a^(b-1) and a^(b-2); where b is a number, derivatives by it are not needed
            lower = self.power(a, self.add(b, number(-1.0)))
            lowest = self.power(a, self.add(b, number(-2.0)))
            slope, bend = times(b, lower), times(times(b, self.add(b, number(-1.0))), lowest)
            if self.value(b) is not None:
                return [slope, zero], [[bend, zero], [zero, zero]]
            log = self.node("log", a)
            mixed = times(lower, self.add(one, times(b, log)))
            return [slope, times(node, log)], [[bend, mixed], [mixed, times(node, times(log, log))]]
        if name == "atan2":
            # of atan(a/b): x = b/(a^2 + b^2) and -y, with y = a/(a^2 + b^2)
            inverse = divide(one, self.add(times(a, a), times(b, b)))
            x, y = times(b, inverse), times(a, inverse)
            bend = times(number(-2.0), times(x, y))
            mixed = self.add(times(y, y), self.minus(times(x, x)))
            return [x, self.minus(y)], [[bend, mixed], [mixed, self.minus(bend)]]
        if name in ("jn", "yn"):
            # J_n' = (J_(n-1) - J_(n+1))/2; None asks for the second derivative
            down, up, further = (self._bessel(name, a, b, k) for k in (-1, 1, None))
            slope = times(number(0.5), self.add(down, self.minus(up)))
            return [zero, slope], [[zero, zero], [zero, further]]
        slope, bend = self._function_rules(node, name, a)
        return [slope], [[bend]]

    def _bessel(self, name: str, order: int, x: int, shift: int | None) -> int:
        """Return a Bessel function of a nearby order, or the second derivative of this one.

        Parameters
        ----------
        name
            "jn" or "yn".
        order, x
            Nodes of the order, a number, and of the argument.
        shift
            Shift of the order; None for the second derivative.
        """
        n = int(self.value(order) or 0)

        def of_order(m: int) -> int:
            """Return the function of order m; J_-m = (-1)^m J_m."""
            positive = self.node(name, self.number(abs(m)), x)
            return positive if m >= 0 or m % 2 == 0 else self.minus(positive)

        if shift is not None:
            return of_order(n + shift)
        # J_n'' = (J_(n-2) - 2 J_n + J_(n+2))/4
        outer = self.add(of_order(n - 2), of_order(n + 2))
        quarter = self.number(0.25)
        inner = self.times(self.number(-2.0), of_order(n))
        return self.times(quarter, self.add(outer, inner))

    def _function_rules(self, node: int, name: str, x: int) -> tuple[int, int]:
        """Return the first and second derivative of a function of one number.

        Parameters
        ----------
        node
            The node of the function's value.
        name, x
            Name of the function, and the node of its argument.

        Raises
        ------
        NotImplementedError
            If the function is not known.
        """
        number, times, divide = self.number, self.times, self.divide
        square = times(x, x)
        one_minus_square = self.add(self.one, self.minus(square))
        match name:
            case "sqrt":
                slope = divide(number(0.5), node)
                return slope, times(number(-0.5), divide(slope, x))
            case "exp":
                return node, node
            case "log":
                slope = divide(self.one, x)
                return slope, self.minus(times(slope, slope))
            case "sin":
                return self.node("cos", x), self.minus(node)
            case "cos":
                return self.minus(self.node("sin", x)), self.minus(node)
            case "tan":
                slope = self.add(self.one, times(node, node))
                return slope, times(number(2.0), times(node, slope))
            case "sinh" | "cosh":
                return self.node("cosh" if name == "sinh" else "sinh", x), node
            case "tanh":
                slope = self.add(self.one, self.minus(times(node, node)))
                return slope, times(number(-2.0), times(node, slope))
            case "asin" | "acos":
                slope = divide(
                    number(1.0 if name == "asin" else -1.0), self.node("sqrt", one_minus_square)
                )
                return slope, divide(times(x, slope), one_minus_square)
            case "atan":
                slope = divide(self.one, self.add(self.one, square))
                return slope, times(number(-2.0), times(x, times(slope, slope)))
            case "erf":
                slope = times(number(2 / np.sqrt(np.pi)), self.node("exp", self.minus(square)))
                return slope, times(number(-2.0), times(x, slope))
        raise NotImplementedError(f"an energy at points has {name}, whose derivative is not known")


def flat(nodes: Nodes) -> list[int]:
    """Return nodes as a list, row by row."""
    return [int(node) for node in nodes.ravel()]


def terminals_of(expressions: Iterable[Expr], *kinds: type) -> tuple[list[Any], ...]:
    """Return the terminals in expressions, such as fields and constants.

    Parameters
    ----------
    kinds
        Classes such as `ufl.Coefficient`.

    Returns
    -------
    A list for each kind, in the order in which the terminals were created.
    """
    terminals = {terminal for e in expressions for terminal in traverse_unique_terminals(e)}
    return tuple(
        sorted((t for t in terminals if isinstance(t, kind)), key=lambda t: t.count())
        for kind in kinds
    )


def _component_tensor(value: Nodes, e: Expr) -> Nodes:
    """Return the nodes of the tensor whose components are A, from those of A.

    Free indices of A that count the components become axes of the shape, and move to the front.

    Parameters
    ----------
    value
        Nodes (*shape, *free indices) of A.
    e
        The tensor.
    """
    tensor, indices = e.ufl_operands
    dimension = len(tensor.ufl_shape)
    axes = [dimension + tensor.ufl_free_indices.index(index.count()) for index in indices]
    return np.asarray(np.moveaxis(value, axes, range(len(axes))))


def _indexed(value: Nodes, e: Expr) -> Nodes:
    """Return the nodes of A[i, 0, ...] from those of A.

    An index that is free in A too makes a diagonal, as i in A_i[i].

    Parameters
    ----------
    value
        Nodes (*shape, *free indices) of A.
    e
        The indexed expression.
    """
    tensor, indices = e.ufl_operands
    # A with its fixed indices, and the label of each axis that is left
    fixed, labels = list[int | slice](), list[int]()
    for index in indices:
        is_fixed = isinstance(index, classes.FixedIndex)
        fixed.append(int(index) if is_fixed else slice(None))
        labels += [] if is_fixed else [index.count()]
    labels += tensor.ufl_free_indices
    # labels are numbered anew: einsum takes numbers below 52 alone
    numbers = {label: i for i, label in enumerate(dict.fromkeys(labels))}
    axes = [numbers[label] for label in labels]
    free_axes = [numbers[label] for label in e.ufl_free_indices]
    # einsum orders the axes, and takes the diagonal of two with one label
    return np.asarray(np.einsum(value[tuple(fixed)], axes, free_axes))


def _aligned(value: Nodes, operand: Expr, e: Expr) -> Nodes:
    """Return the nodes of an operand with an axis for each free index of an expression e.

    Axes that the operand does not have are of length one, so that all operands broadcast.

    Parameters
    ----------
    value
        Nodes (*shape, *free indices) of the operand.
    """
    labels, shape = operand.ufl_free_indices, operand.ufl_shape
    axes = [
        len(shape) + labels.index(label) if label in labels else None
        for label in e.ufl_free_indices
    ]
    present = [axis for axis in axes if axis is not None]
    ordered = np.transpose(value, [*range(len(shape)), *present])
    sizes = [1 if axis is None else value.shape[axis] for axis in axes]
    # a scalar operand has no axes of the shape: ones take their place
    padding = (1,) * (len(e.ufl_shape) - len(shape))
    return ordered.reshape((*padding, *shape, *sizes))
