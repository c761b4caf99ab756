"""Equilibrium paths of Pi(u; mu): Newton on bordered systems, steps, folds, branches; no finite
elements.
"""
