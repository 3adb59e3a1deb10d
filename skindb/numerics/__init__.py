"""Numerical methods on plain arrays: least squares, factorisation, robust estimates, statistics."""
