"""Gradients of results by amplitudes, numbers of a case and fields, each from one adjoint."""
