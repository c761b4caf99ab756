"""How FFCx is made to compile."""

import basix.ufl
import ufl
from ffcx.ir.analysis.graph import build_graph_vertices
from ffcx.ir.analysis.valuenumbering import ValueNumberer

from magshell_fenicsx.assembly.kernels import _node_symbols


def test_nodes_are_found_by_the_dictionary_of_the_graph() -> None:
    """The symbols are those of the first node that is equal, which FFCx itself looks for."""
    domain = ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,)))
    u = ufl.Coefficient(ufl.FunctionSpace(domain, basix.ufl.element("Lagrange", "triangle", 2, shape=(3,))))
    assert ValueNumberer.get_node_symbols is _node_symbols
    numberer = ValueNumberer(build_graph_vertices([u[0] * u[1] + ufl.sin(u[2]) * u[0]], skip_terminal_modifiers=False))
    numberer.compute_symbols()
    nodes = [node["expression"] for node in numberer.G.nodes.values()]
    assert len(nodes) > 5
    for node in nodes:
        first = next(i for i, other in enumerate(nodes) if other == node)
        assert numberer.get_node_symbols(node) is numberer.V_symbols[first]
