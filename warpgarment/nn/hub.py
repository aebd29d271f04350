"""Networks from the Hugging Face Hub: `owner/name`, or `owner/name@revision` for a branch, a tag or a commit.

Only weights, their index and Markdown pages are fetched, into the Hub's own cache: no code, and no pickled files. To
publish a network, save it to a folder, put its card there as README.md, and upload it with the Hub's command line:

    checkpoint.save(network, "base", dtype=torch.bfloat16, max_shard_bytes=16 * 2**20)
    hf upload owner/name base                                  # huggingface-cli upload, in versions before 0.34
"""

from __future__ import annotations

import re
from pathlib import Path

from warpgarment.errors import CheckpointError, MissingExtra

from .shards import INDEX

WANTED = ("*.safetensors", INDEX, "*.md")
UNWANTED = ("*/*",)  # everything in subfolders of the repository
_NAME = re.compile(r"(?!.*\.\.)(\w[\w.-]*/\w[\w.-]*)(?:@(\w[\w./-]*))?", re.ASCII)


def is_repository(name: str) -> bool:
    """Whether a name has the form of a repository's: not that of a deeper path, or of a checkpoint file."""
    return bool(_NAME.fullmatch(name)) and not name.endswith(".safetensors")


def fetch(name: str, tried: str) -> Path:
    """Downloads a repository, or finds it in the Hub's cache.

    Args:
        name: A name for which `is_repository` is true.
        tried: The places where the name was not found, as the first words of an error message.

    Returns:
        The folder of its files.

    Raises:
        MissingExtra: huggingface-hub is not installed.
        CheckpointError: There is no such repository or revision, it is private, or it cannot be reached.
    """
    repository, revision = _NAME.fullmatch(name).groups()  # type: ignore[union-attr]
    try:
        from huggingface_hub import snapshot_download
    except ModuleNotFoundError as error:
        raise MissingExtra("hub", f"{tried}. Looking for it on the Hugging Face Hub") from error
    try:
        return Path(
            snapshot_download(
                repository, revision=revision, allow_patterns=list(WANTED), ignore_patterns=list(UNWANTED)
            )
        )
    except Exception as error:  # which classes there are depends on the Hub's version and on its HTTP library
        reason = str(error).strip().partition("\n")[0]
        raise CheckpointError(
            f"{tried}; nor could it be fetched from the Hugging Face Hub ({type(error).__name__}: {reason})"
        ) from error
