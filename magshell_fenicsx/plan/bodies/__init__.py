"""Signed distances of rigid bodies with gradient and Hessian, one file a kind, and their places."""
