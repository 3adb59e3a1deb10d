"""Methods as numbers: least squares, factorisation, robust estimates, statistics. Knows no labels."""
