"""Float64 NumPy twin of kernels/features/outdoor.py, from the fields of materials by name."""

from __future__ import annotations

import math

import numpy as np

COMMON = {
    "density": (0.3, 1e-3),
    "stretch": (1e3, 1.0),
    "shear": (1e3, 1.0),
    "bend": (1e-3, 1e-6),
    "friction": (0.3, 1e-2),
}


def outdoor(names, now, before, faces, material, air, fps):
    """Channels of the faces of one garment, [F,K]; `material` is a `Material` or None, `air` a velocity [m/s]."""
    rows = []
    for corners in np.asarray(faces):
        way = np.mean([np.asarray(now, np.float64)[v] - np.asarray(before, np.float64)[v] for v in corners], axis=0)
        row = []
        for name in names:
            if name == "wind":
                row += list(np.asarray(air, np.float64) - way * fps)
            elif material is None:
                row.append(math.nan)
            else:
                common, least = COMMON[name]
                row.append(math.log10(max(getattr(material, name), least) / common))
        rows.append(row)
    return np.array(rows)
