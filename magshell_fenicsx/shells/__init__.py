"""The models of a problem: shell, meridian and solid with all parts that load and hold them."""
