"""A surface as plain arrays with names, for .npz files."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .record import Coordinates, Labels, Material, Surface

PREFIX = "surface_"


def to_arrays(surface: Surface | None) -> dict[str, np.ndarray]:
    """Arrays that `from_arrays` makes a surface of; none for None."""
    if surface is None:
        return {}
    unknown = (np.nan, np.nan, np.nan)
    materials = surface.materials
    found = {
        "counts": surface.counts,
        "corners": surface.corners,
        "material": surface.material,
        "materials": _text([m.name for m in materials]),
        "colors": np.array([m.color or unknown for m in materials], dtype=np.float32).reshape(-1, 3),
        "opacities": np.array([np.nan if m.opacity is None else m.opacity for m in materials], dtype=np.float32),
        "textures": _text([m.texture or "" for m in materials]),
        "coordinates": _text([one.name for one in surface.coordinates]),
    }
    for kind, labels in (("object", surface.objects), ("group", surface.groups)):
        found |= {kind: labels.of_polygon, f"{kind}s": _text(list(labels.names))}
    for number, one in enumerate(surface.coordinates):
        found |= {f"uv{number}": one.values, f"uv{number}_corners": one.corners}
    return {PREFIX + key: array for key, array in found.items()}


def from_arrays(arrays: Mapping[str, np.ndarray]) -> Surface | None:
    """The surface in arrays, others among them; None where there is none.

    Raises:
        MeshError, ValueError, KeyError: They do not fit each other.
    """
    found = {key.removeprefix(PREFIX): array for key, array in arrays.items() if key.startswith(PREFIX)}
    if not found:
        return None
    materials = [
        Material(
            str(name),
            (float(color[0]), float(color[1]), float(color[2])) if np.isfinite(color).all() else None,
            float(opacity) if np.isfinite(opacity) else None,
            str(texture) or None,
        )
        for name, color, opacity, texture in zip(
            found["materials"], found["colors"], found["opacities"], found["textures"], strict=True
        )
    ]
    sets = [
        Coordinates(str(name), found[f"uv{k}"], found[f"uv{k}_corners"]) for k, name in enumerate(found["coordinates"])
    ]
    objects, groups = (Labels(tuple(map(str, found[f"{k}s"])), found[k]) for k in ("object", "group"))
    return Surface(found["counts"], found["corners"], tuple(sets), tuple(materials), found["material"], objects, groups)


def _text(words: list[str]) -> np.ndarray:
    return np.array(words, dtype=str) if words else np.zeros(0, dtype="U1")
