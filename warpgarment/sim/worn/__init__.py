"""Garments that are worn together: outfits in the arguments of a simulation, and whether their order is right."""
