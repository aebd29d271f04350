"""Networks from the Hugging Face Hub: `owner/name`, or `owner/name@revision` for a branch, a tag or a commit.

Only weights, their index and pages are fetched, into the Hub's own cache: no code, and nothing that is pickled. To
publish a network, save it to a folder, put its card there as README.md, and let the Hub's command line upload it:

    checkpoint.save(network, "base", dtype=torch.bfloat16, max_shard_bytes=16 * 2**20)
    hf upload owner/name base                                  # huggingface-cli upload, in versions before 0.34
"""

from __future__ import annotations

import re
from pathlib import Path

from warpgarment.errors import CheckpointError, MissingExtra

from .shards import INDEX

WANTED = ("*.safetensors", INDEX, "*.md")
UNWANTED = ("*/*",)  # whatever lies in folders of the repository
_NAME = re.compile(r"(?!.*\.\.)(\w[\w.-]*/\w[\w.-]*)(?:@(\w[\w./-]*))?", re.ASCII)


def is_repository(name: str) -> bool:
    """Whether a name reads like a repository's: not a path of another depth, nor one of a checkpoint file."""
    return bool(_NAME.fullmatch(name)) and not name.endswith(".safetensors")


def fetch(name: str, tried: str) -> Path:
    """Downloads a repository, or finds it in the Hub's cache.

    Args:
        name: For which `is_repository` holds.
        tried: What the name turned out not to be, as the start of an error's sentence.

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
