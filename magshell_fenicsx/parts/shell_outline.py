"""The outline of a case's shell, by its section, and its reference shell.

An outline is a chart of the mid-surface and its map to space over the reference length R. Bodies,
imperfections and sources are placed on the reference shell.
"""

from math import pi, radians

from magshell_fenicsx.mesh.msh import MeshFile
from magshell_fenicsx.parts.revolution_sections import CapSurface
from magshell_fenicsx.parts.shell_sections import MeshSurface, PlateSurface, ShellSection, Surface
from magshell_fenicsx.shape.outline import (
    Outline,
    capped_outline,
    flat_disc_outline,
    mesh_outline,
    plate_outline,
    ring_outline,
    sphere_outline,
    strip_outline,
)
from magshell_fenicsx.shape.reference_shell import ReferenceShell


def reference_shell_of(shell: Surface | ShellSection) -> ReferenceShell:
    """Return the reference shell of a case's shell, without imperfections.

    Imperfections, bodies and sources are placed on it.
    """
    perfect = outline(shell)
    factor = shell.thickness_factor
    azimuth = getattr(shell, "azimuth", None)
    return ReferenceShell(
        geometry=shell.geometry,
        perfect=perfect,
        imperfect=perfect,
        R=shell.reference,
        R_over_h=shell.R_over_h,
        nu=shell.poisson_ratio,
        with_units=shell.with_units,
        edge_polar=shell.edge_polar,
        # only a formula is known at any place
        thickness_factor=factor if isinstance(factor, str) else None,
        # all that the surface depends on, by which it is cached
        identity=(
            shell.model_dump_json(exclude={"imperfections"}),
            shell.digest if isinstance(shell, MeshSurface) else None,
        ),
        hole_polar=getattr(shell, "hole", None) or 0.0,
        azimuths=(azimuth[0], azimuth[1]) if azimuth else None,
    )


def outline(shell: Surface | ShellSection) -> Outline:
    """Return the outline of a shell without imperfections, by its geometry."""
    if isinstance(shell, MeshSurface):
        return mesh_outline(_mesh_file(shell))
    if isinstance(shell, ShellSection) and shell.width is not None:
        return strip_outline(shell.width)
    if isinstance(shell, ShellSection) and shell.geometry == "disc":
        return flat_disc_outline()
    if isinstance(shell, ShellSection):
        return sphere_outline(pi / 2, "equator")
    if isinstance(shell, CapSurface) and shell.hole is None:
        return sphere_outline(radians(shell.polar), "rim")
    if isinstance(shell, PlateSurface):
        return plate_outline(shell.width / shell.reference)
    # a surface of revolution; a profile that ends at a pole has None for the name of this end
    profile, (first_name, last_name) = shell.profile_and_edges
    if last_name is None:
        return capped_outline(profile, first_name)
    is_closed = shell.azimuth is None, shell.closed
    return ring_outline(profile, (first_name, last_name), shell.azimuth_range, is_closed)


def _mesh_file(shell: MeshSurface) -> MeshFile:
    """Return the file of a mesh, or the triangles that stand in its place."""
    scale = (shell.unit or 1.0) / shell.reference  # of the file's lengths over R
    in_memory = shell.files.given.get(shell.path)
    return MeshFile(shell.path, scale, bool(shell.imperfections), shell.files, in_memory)
