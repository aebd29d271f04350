"""The kinds of files that are damaged: how a sound one is made, and what reads it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from . import dressed_files as dressed
from . import mesh_files as meshes
from . import page_files as pages
from . import set_files as sets

TEXTS = (".obj", ".mtl", ".off", ".gltf", ".usda", ".bvh", ".json", ".jsonl")


class Kind(NamedTuple):
    """A kind of file.

    Attributes:
        write: Makes sound files in an empty folder and returns the path that is read.
        read: Reads it: arrays and other values by name. Errors of this package are right, any other is a failure.
        files: Which of the files are damaged.
        noticed: Suffixes of files of which no byte may be another without an error or a problem that is told.
        constant: Whether what is read never differs from what was written, whatever the damage.
        text: Whether the files are text although their suffix does not say so.
        outside: Whether another library takes the file apart that trusts what is inside: the damage is that of copies
            that went wrong (cut short, empty, longer, another file), not of single bytes within.
    """

    write: Callable[[Path], Path]
    read: Callable[[Path], dict[str, Any]]
    files: str = "*"
    noticed: tuple[str, ...] = ()
    constant: bool = False
    text: bool = False
    outside: bool = False


KINDS: dict[str, Kind] = {
    "obj": Kind(meshes.write_obj, meshes.garment),
    "obj_objects": Kind(meshes.write_objects, meshes.everything),
    "obj_folder": Kind(meshes.write_folder, meshes.body),
    "off": Kind(meshes.write_off, meshes.garment),
    "ply_text": Kind(meshes.write_ply_text, meshes.garment, text=True),
    "ply_binary": Kind(meshes.write_ply_binary, meshes.garment),
    "stl_text": Kind(meshes.write_stl_text, meshes.garment, text=True),
    "stl_binary": Kind(meshes.write_stl_binary, meshes.garment),
    "glb": Kind(meshes.write_glb, meshes.garment),
    "glb_skinned": Kind(meshes.write_skinned_glb, meshes.body),
    "gltf": Kind(meshes.write_gltf, meshes.body),
    "usda": Kind(meshes.write_usda, meshes.body),
    "usda_skeleton": Kind(meshes.write_skeleton, meshes.body),
    "usdc": Kind(meshes.write_usdc, meshes.motion, outside=True),
    "usdz": Kind(meshes.write_usdz, meshes.motion, outside=True),
    "pc2": Kind(meshes.write_pc2, meshes.motion),
    "abc": Kind(meshes.write_abc, meshes.motion),
    "mdd": Kind(meshes.write_mdd, meshes.motion),
    "npz_garment": Kind(meshes.write_garment_npz, meshes.garment),
    "npz_motion": Kind(meshes.write_motion_npz, meshes.motion),
    "npz_body": Kind(meshes.write_body_npz, meshes.body),
    "obj_dressed": Kind(dressed.write_obj, dressed.garment),
    "obj_materials": Kind(dressed.write_obj, dressed.garment, files="*.mtl"),
    "folder_dressed": Kind(dressed.write_folder, dressed.stage),
    "npz_dressed": Kind(dressed.write_npz, dressed.stage),
    "usda_dressed": Kind(dressed.write_usda, dressed.stage),
    "glb_dressed": Kind(dressed.write_glb, dressed.stage),
    "gltf_dressed": Kind(dressed.write_gltf, dressed.garment),
    "ply_dressed": Kind(dressed.write_ply, dressed.garment, text=True),
    "sequence": Kind(sets.add_sequence, sets.sequence),
    "sequence_manifest": Kind(sets.add_sequence, sets.sequence, files="manifest.json"),
    "set_verified": Kind(sets.add_set, sets.checked_set, noticed=(".npy",)),
    "set_card": Kind(sets.add_set, sets.card, files="*.json"),
    "set_manifest": Kind(sets.add_set, sets.set_manifest, files="set.json"),
    "bvh": Kind(sets.write_bvh, sets.clip),
    "amass": Kind(sets.write_amass, sets.clip),
    "vto": Kind(sets.write_vto, sets.recording),
    "vto_npz": Kind(sets.write_vto_npz, sets.recording),
    "dlayers": Kind(sets.write_dlayers, sets.recording),
    "cloth3d": Kind(sets.write_cloth3d, sets.recording),
    "pc16": Kind(sets.write_pc16, sets.pc16),
    "mat": Kind(sets.write_mat, sets.mat),
    "pickle": Kind(sets.write_pickle, sets.pickled),
    "cache": Kind(sets.write_kept, sets.kept, constant=True),
    "interactions": Kind(sets.write_interactions, sets.interactions, files="cache/*/*", constant=True),
    "checkpoint": Kind(sets.write_checkpoint, sets.network),
    "checkpoint_shards": Kind(sets.write_shards, sets.network),
    "training_state": Kind(sets.write_state, sets.training_state),
    "evaluation": Kind(pages.write_evaluation, pages.evaluation),
    "log": Kind(pages.write_log, pages.log),
    "row": Kind(pages.write_row, pages.row),
    "rest_body": Kind(pages.write_rest_body, pages.rest_body),
    "page_text": Kind(pages.write_log, pages.text),
}
