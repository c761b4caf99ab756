// Two parallel strips, 4 mm long and 1 mm wide, 1.5 mm apart: gmsh -2 -o meshes/strips.msh meshes/strips.geo
SetFactory("OpenCASCADE");
Rectangle(1) = {0, -0.5, 0, 4, 1};
Rectangle(2) = {0, -0.5, 1.5, 4, 1};
Physical Surface("lower") = {1};
Physical Surface("upper") = {2};
Physical Curve("lower_edge") = {1, 2, 3, 4};
Physical Curve("upper_edge") = {5, 6, 7};
Physical Curve("root") = {8};
Mesh.MeshSizeMin = 0.7;
Mesh.MeshSizeMax = 0.7;
