"""FFCx's maps between the components of indexed tensors, by NumPy: its own loops take a sixth of all compilation."""

from math import prod

import numpy as np
from ffcx.ir.analysis import valuenumbering
from numpy.typing import NDArray
from ufl.classes import ComponentTensor, Expr, FixedIndex, Indexed


def of_indexed(indexed: Indexed) -> list[int]:
    """Component of A[i, ...] -> that of A."""
    tensor, places = indexed.ufl_operands
    numbers, fixed, labels = _numbers(tensor), list[int | slice](), list[int]()
    for place in places:
        fixed.append(int(place) if isinstance(place, FixedIndex) else slice(None))
        labels += [] if isinstance(place, FixedIndex) else [place.count()]
    return _ordered(numbers[tuple(fixed)], [*labels, *tensor.ufl_free_indices], indexed.ufl_free_indices)


def of_component_tensor(tensor: ComponentTensor) -> list[int]:
    """Component of as_tensor(a, (i, ...)) -> that of a."""
    a, places = tensor.ufl_operands
    return _ordered(_numbers(a), a.ufl_free_indices, [*(i.count() for i in places), *tensor.ufl_free_indices])


def _numbers(tensor: Expr) -> NDArray[np.int64]:
    """Each component's number, along the indices of the shape and then along the free ones."""
    shape = tensor.ufl_shape + tensor.ufl_index_dimensions
    return np.arange(prod(shape)).reshape(shape)


def _ordered(numbers: NDArray[np.int64], labels: list[int], wanted: list[int]) -> list[int]:
    """The numbers along the wanted labels; equal labels run together."""
    short = {label: i for i, label in enumerate(dict.fromkeys(labels))}  # einsum knows 52
    found: list[int] = np.einsum(numbers, [short[i] for i in labels], [short[i] for i in wanted]).ravel().tolist()
    return found


def install_index_maps() -> None:
    """Take the place of FFCx's own functions."""
    valuenumbering.map_indexed_arg_components = of_indexed
    valuenumbering.map_component_tensor_arg_components = of_component_tensor
