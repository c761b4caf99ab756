"""Mid-surfaces: shapes, files, gradings, and their triangles and hexahedra."""
