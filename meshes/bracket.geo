// A bracket folded at a right angle: a flange 1 high and a shelf 1 deep, 0.4 wide, meeting in the fold.
// gmsh -2 -order 1 -o meshes/bracket.msh meshes/bracket.geo
SetFactory("Built-in");
size = 0.25;
Point(1) = {0, 0, 0, size};    Point(2) = {0, 0.4, 0, size};
Point(3) = {0, 0, 1, size};    Point(4) = {0, 0.4, 1, size};
Point(5) = {1, 0, 1, size};    Point(6) = {1, 0.4, 1, size};
Line(1) = {1, 2};  Line(2) = {2, 4};  Line(3) = {4, 3};  Line(4) = {3, 1};
Line(5) = {4, 6};  Line(6) = {6, 5};  Line(7) = {5, 3};
Curve Loop(1) = {1, 2, 3, 4};   Plane Surface(1) = {1};
Curve Loop(2) = {-3, 5, 6, 7};  Plane Surface(2) = {2};
Physical Surface("flange") = {1};
Physical Surface("shelf") = {2};
Physical Curve("root") = {1};
Physical Curve("tip") = {6};
Physical Curve("sides") = {2, 4, 5, 7};
