"""Caches of positions alone: the mesh that has their faces lies beside them, under the same name."""
