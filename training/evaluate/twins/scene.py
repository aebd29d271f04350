"""The scene of a recorded sequence, made again from its manifest and compared with what was recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.objects.material import Material
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.garments.outfits import OutfitPattern
from warpgarment.training.garments.pattern import Pattern
from warpgarment.training.garments.seams import Seam, Seams
from warpgarment.training.generate.recipes import GenerateConfig, Plan
from warpgarment.training.generate.run import prepare
from warpgarment.training.generate.wind import Wind
from warpgarment.training.teachers import ClothScene, Teacher

NEAR = 2e-5  # another processor may give other last bits of a body or a garment [m]
_AGAIN = "The code or its packages have changed since; generate the set again, or use those of that time."


class TwinError(ValueError):
    """A twin cannot be made or read; the message says which sequence and why."""


def plan_of(sequence: Sequence) -> Plan:
    """The plan that a sequence was made by, from its manifest.

    Raises:
        TwinError: The manifest has no plan, as that of a sequence imported from elsewhere, or one of another version.
    """
    parameters = sequence.manifest.get("parameters")
    if not isinstance(parameters, dict) or "outfit" not in parameters:
        raise TwinError(f"{sequence.name}: its manifest has no plan, so that its scene cannot be made again.")
    values = {key: _plain(value) for key, value in parameters.items() if key not in ("teacher", "limits")}
    names = {field.name for field in fields(Plan)}
    if names != set(values):
        raise TwinError(f"{sequence.name}: its plan has another {', '.join(sorted(names ^ set(values)))}. {_AGAIN}")
    try:
        outfit = values["outfit"]
        values["outfit"] = OutfitPattern(**outfit | {"layers": tuple(Pattern(**one) for one in outfit["layers"])})
        values["materials"] = tuple(Material(**one) for one in values["materials"])
        values["wind"] = Wind(**values["wind"]) if values["wind"] else None
        values["seams"] = Seams(tuple(Seam(**one) for one in values["seams"]["cuts"])) if values["seams"] else None
        return Plan(**values)
    except (TypeError, ValueError, KeyError) as error:
        raise TwinError(f"{sequence.name}: its plan cannot be read ({error}). {_AGAIN}") from None


def check_teacher(sequence: Sequence, teacher: Teacher) -> None:
    """Refuses a teacher of other settings or versions than that of a sequence.

    Raises:
        TwinError: It differs; the message names each setting and both values.
    """
    recorded = sequence.manifest.get("parameters", {}).get("teacher", {})
    now = json.loads(json.dumps(teacher.settings()))
    different = [
        f"{key} was {recorded.get(key)!r}, is {now.get(key)!r}"
        for key in sorted({*recorded, *now})
        if recorded.get(key) != now.get(key)
    ]
    if different:
        raise TwinError(f"{sequence.name}: made by another teacher: {'; '.join(different)}.")


def scene_of(sequence: Sequence, motions: Path | None = None) -> ClothScene:
    """The scene from which a sequence was simulated, of its whole length also where the recording was cut short.

    Args:
        sequence: The sequence.
        motions: Folder of the clips that the set was made with; None if this one has a procedural motion.

    Raises:
        TwinError: The scene cannot be made, or has another body, motion, garment or wind than was recorded.
    """
    plan = plan_of(sequence)
    if not plan.motion.startswith("procedural:"):
        if motions is None:
            raise TwinError(f"{sequence.name}: {plan.motion} is a clip. Name the folder of clips (--motions).")
        if not any(path.stem == plan.motion for path in Path(motions).rglob("*")):
            raise TwinError(f"{sequence.name}: there is no clip {plan.motion} in {motions}.")
    attempt = prepare(plan, GenerateConfig(out=Path(), motions=motions, least_frames=1))
    if attempt.scene is None:
        raise TwinError(f"{sequence.name}: {attempt.reason}")
    recorded = sequence.arrays()
    for name in sorted({*recorded, *attempt.arrays} - {"garment_vertices", "garment_velocities"}):
        if name not in recorded and name == "garment_starts" and len(attempt.arrays[name]) == 2:
            continue  # the only garment
        fault = _difference(recorded.get(name), attempt.arrays.get(name), name in ("bone_transforms", "wind"))
        if fault:
            raise TwinError(f"{sequence.name}: {name} of the scene made again {fault}. {_AGAIN}")
    return attempt.scene


def noisy(scene: ClothScene, noise: float, rng: np.random.Generator) -> ClothScene:
    """A scene whose free vertices start elsewhere; pins stay, since their places on the body follow from them.

    Args:
        scene: The scene.
        noise: Standard deviation of each coordinate [m]; 0 gives the scene itself.
        rng: Generator of the noise.
    """
    cloths = []
    for cloth in scene.cloths:
        moved = rng.normal(0.0, 1.0, cloth.first.shape) * noise
        moved[cloth.garment.pins] = 0.0
        start = cloth.start if noise == 0 else (cloth.first + moved).astype(np.float32)
        cloths.append(replace(cloth, start=start))
    return replace(scene, cloths=tuple(cloths))


def _difference(recorded: np.ndarray | None, made: np.ndarray | None, cut: bool) -> str | None:
    """What differs; `cut` for arrays of frames, of which fewer may be recorded."""
    if recorded is None or made is None:
        return "is " + ("not recorded" if recorded is None else "missing")
    made = made[: len(recorded)] if cut else made
    if made.shape != recorded.shape:
        return f"has shape {list(made.shape)}, recorded is {list(recorded.shape)}"
    off = float(np.abs(made.astype(np.float64) - recorded.astype(np.float64)).max(initial=0.0))
    return f"differs by {off:.2g}" if off > (NEAR if made.dtype.kind == "f" else 0.0) else None


def _plain(value: Any) -> Any:
    """JSON's lists as tuples, as dataclasses hold them."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    return tuple(map(_plain, value)) if isinstance(value, list) else value
