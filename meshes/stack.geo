// Three shallow caps above each other (mm), each a patch with its rim.
// gmsh -2 -order 3 -o meshes/stack.msh meshes/stack.geo
SetFactory("OpenCASCADE");
a = 6;
H = 1.1;
gap = 3;
R = (a^2 + H^2)/(2*H);
For i In {0:2}
  Sphere(i + 1) = {0, 0, i*gap + H - R, R, Asin((R - H)/R), Pi/2};
EndFor
Physical Surface("lower") = {1};
Physical Surface("middle") = {3};
Physical Surface("upper") = {5};
Physical Curve("lower_rim") = {3};
Physical Curve("middle_rim") = {6};
Physical Curve("upper_rim") = {9};
Mesh.MeshSizeMin = 3;
Mesh.MeshSizeMax = 3;
