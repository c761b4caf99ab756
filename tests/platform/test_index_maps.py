"""Maps between components, against FFCx's own."""

import basix.ufl
import pytest
import ufl
from ffcx.ir.analysis import indexing
from ufl.classes import ComponentTensor, Indexed

from magshell_fenicsx.platform.index_maps import of_component_tensor, of_indexed

DOMAIN = ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,)))
A = ufl.Coefficient(ufl.FunctionSpace(DOMAIN, basix.ufl.element("Lagrange", "triangle", 1, shape=(3, 2))))
B = ufl.Coefficient(ufl.FunctionSpace(DOMAIN, basix.ufl.element("Lagrange", "triangle", 1, shape=(3, 3))))
i, j, k, m = ufl.indices(4)


@pytest.mark.parametrize("multi", [(i, j), (j, i), (i, 1), (2, j), (2, 1)])
def test_indexed(multi: tuple[object, ...]) -> None:
    indexed = A[multi]
    assert isinstance(indexed, Indexed)
    assert of_indexed(indexed) == indexing.map_indexed_arg_components(indexed)


def test_indexed_with_free_indices() -> None:
    """The last is a trace: the index is free in the tensor too."""
    tensor = ufl.as_tensor(A[i, j] * B[k, 0], (k,))
    trace = ufl.as_tensor(B[i, k], (k,))[i].ufl_operands[0]
    for indexed in (tensor[m], tensor[1], trace):
        assert isinstance(indexed, Indexed)
        assert of_indexed(indexed) == indexing.map_indexed_arg_components(indexed)


@pytest.mark.parametrize("order", [(i, j, k), (k, j, i), (j, k), (k,)])
def test_component_tensor(order: tuple[object, ...]) -> None:
    tensor = ufl.as_tensor(A[i, j] * B[k, 0], order)
    assert isinstance(tensor, ComponentTensor)
    assert of_component_tensor(tensor) == indexing.map_component_tensor_arg_components(tensor)
