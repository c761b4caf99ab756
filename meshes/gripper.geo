// A gripper: a hub of 1 x 1 with four arms of 3 x 0.5, each a patch.
// gmsh -2 -order 2 -o meshes/gripper.msh meshes/gripper.geo
SetFactory("OpenCASCADE");
Rectangle(1) = {-0.5, -0.5, 0, 1, 1};
Rectangle(2) = {0.5, -0.25, 0, 3, 0.5};
Rectangle(3) = {-0.25, 0.5, 0, 0.5, 3};
Rectangle(4) = {-3.5, -0.25, 0, 3, 0.5};
Rectangle(5) = {-0.25, -3.5, 0, 0.5, 3};
BooleanFragments{ Surface{1}; Delete; }{ Surface{2:5}; Delete; }
Physical Surface("hub") = {1};
Physical Surface("east") = {2};
Physical Surface("north") = {3};
Physical Surface("west") = {4};
Physical Surface("south") = {5};
outline() = CombinedBoundary{ Surface{:}; };
Physical Curve("outline") = {outline()};
Mesh.MeshSizeMax = 0.5;
