"""The shell beside the solid, or one case beside another."""
