"""D-LAYERS (Shao, Loy, Dai, ICCV 2023): layered outfits on SMPL bodies in the wind, simulated with Blender.

    ROOT/data/00396/meta.json              parts and settings of the sample
    ROOT/data/00396/<garment>.pkl          {"vertices" [T,V,3], "faces" [F,3], "tpose" [V,3]}, one per garment
    ROOT/data/00396/uv_<garment>.pkl       texture coordinates (not read)
    ROOT/<motion_path of meta.json>        {"poses" [N,72], "trans" [N,3]} of the whole clip

`meta.json` has `human` (gender, betas, motion_path, seq_start, seq_end, frame_start, scale, collision), `garment` (a
list of name and `cloth`, Blender's settings) and `wind` (one field with a `pivot_list` of frame_start,
rotation_quaternion (w, x, y, z) and strength, along its own +Z; each entry is valid until the next). Some releases have
them under `simulate`. All lengths are `scale` = 10 times life size, with Z up; the recording has life size and Y up.
The pickles are read by `unpickle`, which executes nothing.

All this is known from the authors' two public readers and the paper's supplement; no sample was available. **Not
verified** are

- that the T-pose shape is Y up, SMPL's own axes (the authors' viewer draws it beside SMPL's zero pose);
- the order of layers: `garment` as listed, but jackets, the paper's outer garments, last;
- the rate of 30 fps, which is the clips';
- Blender's gravity: if it was left at 9.81, things fall at 0.88 m/s^2 at life size, 30 frames per second.

Garments with more frames than the clip are cut to its length, as in the authors' own training. Blender's settings of
cloth and wind are kept in `attributes`; `materials` and `wind` are these settings in SI units, see `blender_cloth`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import below, read_json
from warpgarment.io.npz import read_npz

from .axes import y_up
from .blender_cloth import blender_material, mass_ratio, wind_speed
from .fields import betas, number, numbers
from .recording import RecordedGarment, Recording, recorded_garment
from .smpl import BodySource, SmplPoses, body_from
from .unpickle import SHARE, SPARE, read_pickle

META = "meta.json"
FPS = 30.0
MOST_FRAMES = 100_000  # of a sample


def read_dlayers(
    folder: str | Path, *, body: BodySource = None, root: str | Path | None = None, clean: bool = False
) -> Recording:
    """Reads a sample. Nothing in its pickles is executed.

    Args:
        folder: Folder of the sample, with `meta.json`.
        body: Motion of the body, or a function that makes it from the sample's SMPL poses; see `smpl.body_from`.
        root: Folder to which `motion_path` is relative; None for the one two levels above `folder`.
        clean: Whether rest meshes that are not valid for a garment are repaired; the frames follow.

    Raises:
        PickleRefused: A pickle holds something other than plain data, or is damaged.
        MeshError: A file or a field of `meta.json` is missing, or files do not fit each other.
    """
    folder = Path(folder)
    meta = _meta(folder)
    human, entries = meta["human"], _outer_last(folder, meta["garment"])
    scale = _number(folder, human, "scale")
    first, last = int(_number(folder, human, "seq_start")), int(_number(folder, human, "seq_end"))
    if last - first > MOST_FRAMES:
        raise MeshError(f"{folder / META}: frames {first:,} to {last:,}: at most {MOST_FRAMES:,} of them are read.")
    if scale <= 0 or not 0 <= first < last:
        raise MeshError(f"{folder / META}: scale {scale:g}, frames {first} to {last}: not a sequence.")
    poses = None
    if body is None or callable(body):
        poses = _poses(folder, human, Path(root) if root else folder.parent.parent, first, last)
    garments = tuple(_garment(folder, entry["name"], scale, last - first, clean) for entry in entries)
    friction = human.get("collision", {}).get("friction") if isinstance(human.get("collision"), dict) else None
    ratio = mass_ratio([garment.rest for garment in garments])
    cloths = [entry["cloth"] if isinstance(entry.get("cloth"), dict) else {} for entry in entries]
    materials = tuple(
        blender_material(cloth, garment.rest, ratio=ratio, friction=friction, scale=scale, fps=FPS)
        for cloth, garment in zip(cloths, garments, strict=True)
    )
    pivots = _pivots(folder, meta)
    return Recording(
        garments,
        body_from(body, poses),
        FPS,
        materials,
        _wind(folder, human, pivots, last - first, ratio, scale),
        source=f"D-LAYERS {folder.name}",
        poses=poses,
        attributes={
            "motion": human.get("motion_path"),
            "garment": entries,
            "wind": pivots,
            "collision": human.get("collision"),
            "scale": scale,
        },
    )


def _meta(folder: Path) -> dict[str, Any]:
    path = folder / META
    if not path.is_file():
        raise MeshError(f"{folder} holds no {META}: it is not the folder of a D-LAYERS sample.")
    try:
        meta = read_json(path)
    except MeshError as error:
        raise MeshError(f"{path}: not readable JSON ({error})") from None
    if isinstance(meta, dict) and isinstance(meta.get("simulate"), dict):
        meta = {**meta["simulate"], **meta}
    known = isinstance(meta, dict) and isinstance(meta.get("human"), dict) and isinstance(meta.get("garment"), list)
    if not known:
        raise MeshError(f"{path}: no 'human' and 'garment' in it; this is not the description of a D-LAYERS sample.")
    return meta


def _outer_last(folder: Path, entries: list[Any]) -> list[dict[str, Any]]:
    names = [e.get("name") if isinstance(e, dict) else None for e in entries]
    if not names or not all(isinstance(name, str) and name == Path(name).name for name in names):
        raise MeshError(f"{folder / META}: 'garment' must list garments with their names.")
    missing = [f"{e['name']}.pkl" for e in entries if not (folder / f"{e['name']}.pkl").is_file()]
    if missing:
        raise MeshError(
            f"{folder}: {len(missing)} of {len(entries)} garments are missing: {', '.join(missing)}. The simulation "
            "failed there or the sample is not complete: unpack it again, or leave it out."
        )
    return sorted(entries, key=lambda entry: entry["name"].startswith("jacket"))


def _garment(folder: Path, name: str, scale: float, count: int, clean: bool) -> RecordedGarment:
    path = folder / f"{name}.pkl"
    data = read_pickle(path)
    frames = _array(path, data, "vertices", "f", (None, None, 3))
    faces, rest = _array(path, data, "faces", "iu", (None, 3)), _array(path, data, "tpose", "f", (None, 3))
    if len(frames) < count:
        raise MeshError(f"{path}: {len(frames):,} frames where {META} says {count:,}. It is cut short.")
    return recorded_garment(name, rest / scale, faces, y_up(frames[:count]) / scale, where=str(path), clean=clean)


def _array(path: Path, data: Any, key: str, kinds: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """An array, or a list of arrays of one shape, from a dictionary; None in `shape` stands for any size."""
    array = data.get(key) if isinstance(data, dict) else None
    if isinstance(array, list) and array and all(isinstance(part, np.ndarray) for part in array):
        size, most = sum(part.nbytes for part in array), SHARE * path.stat().st_size + SPARE
        if size > most:
            raise MeshError(f"{path}: {key!r} is a list of {size:,} bytes; a file of this size may hold {most:,}.")
        array = np.stack(array) if len({part.shape for part in array}) == 1 else None
    if isinstance(array, np.ndarray) and array.dtype.kind in kinds and array.ndim == len(shape):
        if all(want in (None, size) for want, size in zip(shape, array.shape, strict=True)):
            return array
    what = f"{array.dtype} {list(array.shape)}" if isinstance(array, np.ndarray) else "missing"
    needed = ",".join("N" if size is None else str(size) for size in shape)
    raise MeshError(f"{path}: {key!r} must be an array of numbers [{needed}], it is {what}.")


def _poses(folder: Path, human: dict[str, Any], root: Path, first: int, last: int) -> SmplPoses:
    path = below(root, human.get("motion_path"), f"{folder / META}: human.motion_path")
    if not path.is_file():
        raise MeshError(
            f"{folder}: the clip {human.get('motion_path')!r} is not below {root}. Give the folder it is relative to "
            "with root=, or a body motion with body=."
        )
    data = read_npz(path) if path.suffix.lower() == ".npz" else read_pickle(path)
    arrays = []
    for key, columns in (("poses", 72), ("trans", 3)):
        array = _array(path, data, key, "f", (None, columns))
        if len(array) == 1:
            array = np.broadcast_to(array, (last, columns))  # which needs no memory
        if len(array) < last:
            raise MeshError(f"{path}: {len(array):,} frames of {key}, {folder / META} asks for {first:,} to {last:,}.")
        arrays.append(array[first:last].astype(np.float64))
    shape = np.ravel(betas(f"{folder / META}: human.betas", human.get("betas", [0.0] * 10), 1))
    gender = str(human.get("gender", "neutral"))
    return SmplPoses(arrays[0].reshape(-1, 24, 3), arrays[1], shape, gender, FPS, source=str(path))


def _pivots(folder: Path, meta: dict[str, Any]) -> list[dict[str, Any]]:
    fields = meta.get("wind") or []
    if not isinstance(fields, list) or len(fields) > 1 or not all(isinstance(field, dict) for field in fields):
        raise MeshError(f"{folder / META}: 'wind' must be a list of one field.")
    pivots = fields[0].get("pivot_list", []) if fields else []
    if not isinstance(pivots, list) or not all(isinstance(pivot, dict) for pivot in pivots):
        raise MeshError(f"{folder / META}: 'wind' must have a 'pivot_list' of fields, it has {str(pivots)[:40]!r}.")
    return pivots


def _wind(
    folder: Path, human: dict[str, Any], pivots: list[dict[str, Any]], frames: int, ratio: float, scale: float
) -> np.ndarray | None:
    """Velocity of the air in each frame [m/s], Y up, shape [T, 3]; None for still air."""
    if not pivots:
        return None
    wind, place = np.zeros((frames, 3)), f"{folder / META}: 'wind' cannot be read: pivot_list"
    begin = _number(folder, human, "frame_start")
    starts = [number(f"{place}[{k}].frame_start", pivot.get("frame_start")) for k, pivot in enumerate(pivots)]
    for k in sorted(range(len(pivots)), key=starts.__getitem__):
        turn = numbers(f"{place}[{k}].rotation_quaternion", pivots[k].get("rotation_quaternion"))
        if len(turn) != 4 or not turn.any():
            raise MeshError(f"{place}[{k}].rotation_quaternion must be four numbers, w, x, y, z, not all of them zero.")
        strength = np.ravel(numbers(f"{place}[{k}].strength", pivots[k].get("strength"), (0, 1)))[0]
        speed = wind_speed(float(strength), ratio=ratio, scale=scale, fps=FPS)
        start = int(np.clip(starts[k] - begin, 0, frames))
        wind[start:] = y_up(Rotation.from_quat(np.roll(turn, -1)).apply([0.0, 0.0, speed]))
    return wind


def _number(folder: Path, human: dict[str, Any], name: str) -> float:
    return number(f"{folder / META}: human.{name}", human.get(name))
