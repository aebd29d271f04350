"""The training loop and its settings."""

from .config import TrainConfig
from .start import train

__all__ = ["TrainConfig", "train"]
