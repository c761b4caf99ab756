"""The curvature and the size that the shell would have without stress."""
