"""Energies as vectors and matrices: point kernels, batches of cells, sparsity, scatter.

Knows no shells.
"""
