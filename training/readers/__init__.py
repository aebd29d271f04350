"""Readers for data sets that others have made; they return a `Recording` in SI units with Y up.

    recording = read_recording("CLOTH3D/train/01_01_s0", body=smpl)       # the format is found by content
    write_as_sequence(recording, "DATA/01_01_s0", split="train")          # `warpgarment train --data DATA`

See docs/readers.md. No reader executes anything in a file.
"""

from .cloth3d import read_cloth3d
from .dlayers import read_dlayers
from .files import recording
from .formats import FORMATS, detect, read_recording
from .pc16 import read_pc16
from .recording import RecordedGarment, Recording
from .smpl import SmplPoses
from .unpickle import PickleRefused, read_pickle
from .vto import convert_vto, read_vto
from .writing import write_as_sequence

__all__ = [
    "FORMATS",
    "PickleRefused",
    "RecordedGarment",
    "Recording",
    "SmplPoses",
    "convert_vto",
    "detect",
    "read_cloth3d",
    "read_dlayers",
    "read_pc16",
    "read_pickle",
    "read_recording",
    "read_vto",
    "recording",
    "write_as_sequence",
]
