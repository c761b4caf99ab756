"""Fields for ParaView: one .vtu per saved point, with curved triangles, and a .pvd of all."""

from pathlib import Path

import numpy as np
import pyvista

from magshell_fenicsx.results.surface import LAGRANGE_TRIANGLE, TRIANGLE, Surface


def unstructured_grid(surface: Surface, h: float) -> pyvista.UnstructuredGrid:
    """The deformed surface with u/h, w/h, r0, n0 and the magnetic loads at its nodes; lengths in R."""
    count = surface.cells.shape[1]
    cells = np.column_stack([np.full(len(surface.cells), count), surface.cells])
    kinds = np.full(len(surface.cells), TRIANGLE if count == 3 else LAGRANGE_TRIANGLE, dtype=np.uint8)
    grid = pyvista.UnstructuredGrid(cells.ravel(), kinds, surface.r0 + surface.u)
    grid.point_data["u_over_h"] = surface.u / h
    grid.point_data["w_over_h"] = surface.w / h
    grid.point_data["r0"] = surface.r0
    grid.point_data["n0"] = surface.n0
    for name, values in surface.fields.items():
        grid.point_data[name] = values
    return grid


class FieldSeries:
    """Writes `point_NNNN.vtu` files and keeps `path.pvd` complete after each."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names: list[tuple[int, str]] = []
        folder.mkdir(exist_ok=True)

    def write(self, number: int, surface: Surface, h: float) -> None:
        name = f"point_{number:04d}.vtu"
        unstructured_grid(surface, h).save(self._folder / name)
        self._names.append((number, name))
        rows = "\n".join(f'    <DataSet timestep="{n}" part="0" file="{f}"/>' for n, f in self._names)
        (self._folder / "path.pvd").write_text(
            '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
            f"{rows}\n  </Collection>\n</VTKFile>\n"
        )
