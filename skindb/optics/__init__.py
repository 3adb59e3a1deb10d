"""Optics as numbers: Fresnel, diffusion, angles, tables of measured BRDFs. Knows no labels."""
