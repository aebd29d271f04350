"""AMASS motions as moving bodies: .npz files of joint angles."""

from __future__ import annotations

from warpgarment.io.data import Format

from .amass import is_amass
from .moved import from_amass

FORMAT = Format(read_motion=from_amass, axis=True, bones=True, recognised=is_amass)
