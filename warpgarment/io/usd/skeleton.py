"""Meshes that a skeleton or blend shapes move (UsdSkel), deformed by USD's own functions."""

from __future__ import annotations

from typing import Any

import numpy as np


class Skinning:
    """How UsdSkel deforms one mesh.

    Attributes:
        frame: The prim in whose space `points` are: the skeleton, or the mesh where blend shapes alone move it.
        samples: Time codes at which joints or weights of blend shapes have values.
    """

    def __init__(self, prim: Any, query: Any, skeleton: Any, bound: Any):
        from pxr import UsdSkel

        self._prim, self._query, self._skeleton = prim, query, skeleton
        self._animation = skeleton.GetAnimQuery()
        self._joints = bool(query.HasJointInfluences())
        self._shapes = bool(query.HasBlendShapes() and self._animation)
        self.frame = bound if self._joints else prim
        self.samples: list[float] = []
        if self._animation and self._joints:
            self.samples += self._animation.GetJointTransformTimeSamples()
        if self._shapes:
            self.samples += self._animation.GetBlendShapeWeightTimeSamples()
            self._blend = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
            self._offsets = self._blend.ComputeSubShapePointOffsets()
            self._indices = self._blend.ComputeBlendShapePointIndices()

    def points(self, points: Any, time: Any) -> np.ndarray:
        """Deformed positions in the space of `frame`.

        Args:
            points: The mesh's points, a Vec3fArray [V].
            time: The time code.

        Raises:
            ValueError: The arrays of the binding do not fit each other.
        """
        from pxr import Vt

        moved = Vt.Vec3fArray(points)
        if self._shapes:
            weights = self._animation.ComputeBlendShapeWeights(time)
            mapper = self._query.GetBlendShapeMapper()
            weights = mapper.Remap(weights) if mapper else weights
            if weights is None:
                raise ValueError("the weights of its blend shapes do not fit")
            shares, shapes, parts = self._blend.ComputeSubShapeWeights(weights)
            if not self._blend.ComputeDeformedPoints(shares, shapes, parts, self._indices, self._offsets, moved):
                raise ValueError("its blend shapes do not fit its points")
        if self._joints:
            transforms = self._skeleton.ComputeSkinningTransforms(time)
            if not transforms or not self._query.ComputeSkinnedPoints(transforms, moved, time):
                raise ValueError("its joints and weights do not fit its points or its skeleton")
        return np.array(moved, dtype=np.float64).reshape(-1, 3)


def skinning_of(prim: Any) -> Skinning | None:
    """The skinning of a mesh; None where no skeleton moves it.

    A mesh is moved by a skeleton only below a SkelRoot, as USD has it.
    """
    from pxr import Usd, UsdSkel

    root = UsdSkel.Root.Find(prim)
    if not root:
        return None
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.TraverseInstanceProxies())
    query = cache.GetSkinningQuery(prim)
    bound = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
    if not query or not bound:
        return None
    skeleton = cache.GetSkelQuery(bound)
    if not skeleton or not (query.HasJointInfluences() or query.HasBlendShapes()):
        return None
    return Skinning(prim, query, skeleton, bound.GetPrim())  # the query's own prim may be an instance's prototype
