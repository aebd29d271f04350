"""Signed distance to bodies: closest points, inside or outside, and how deep cloth is between its vertices."""

from .bodies import BodyMeshes, BodyQuery
from .query import signed_distance

__all__ = ["BodyMeshes", "BodyQuery", "signed_distance"]
