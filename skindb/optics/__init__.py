"""Numerical optics on plain arrays: Fresnel equations, diffusion, angles, and tables of
measured BRDFs.
"""
