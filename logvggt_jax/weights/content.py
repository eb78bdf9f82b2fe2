"""What a file holds, by its first bytes: suffixes of checkpoints say nothing."""

import codecs
import re
from pathlib import Path
from typing import Literal

from logvggt_jax.errors import InputError
from logvggt_jax.files import open_regular

Content = Literal["safetensors", "zip", "json"]
"""A safetensors file; an archive, as `torch.save` writes them; a JSON text, as indices of shards are."""

# Enough for the mark of a tar archive, which begins at byte 257.
_START = 512
_AGAIN = "copy or download it again"
_EXPORT = "export the PyTorch state dict as model.safetensors"
_ARCHIVE = "unpack it and give the checkpoint inside"
# In this order; what a file of each kind begins with, what it is called, how to mend it.
_OTHERS: tuple[tuple[bytes, str, str], ...] = (
    (rb"version https://git-lfs", "a pointer of Git LFS, not the file itself", "run `git lfs pull` in its repository"),
    (rb"\s*<", "a web page or an XML text, such as a server's error instead of the file", "download it again"),
    (rb"\x89HDF", "an HDF5 file", _EXPORT),
    (rb"GGUF|gg(ml|mf|jt)|lmgg|fmgg|tjgg", "a GGUF or GGML file", _EXPORT),
    (rb".{4}TFL3", "a TensorFlow Lite file", _EXPORT),
    (rb"\x93NUMPY", "a NumPy array", _EXPORT),
    (rb".{257}ustar", "a tar archive, as torch.save wrote before PyTorch 0.2 as well", _ARCHIVE),
    (rb"\x1f\x8b|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd|7z\xbc\xaf|Rar!", "a compressed file", _ARCHIVE),
    (
        rb"\x80[\x02-\x05]",
        "a bare pickle, as torch.save wrote before PyTorch 1.6; it is not read",
        "load it in a current PyTorch with torch.load(path, weights_only=True) and torch.save it again, or save it as "
        "model.safetensors",
    ),
    # ONNX: a message whose first field is the version of the format, and after it the producer's name.
    (rb"\x08[\x01-\x20]([\x12\x1a\x22\x28\x32\x3a\x42]|$)", "an ONNX model", _EXPORT),
    (rb"\xff\xd8\xff|\x89PNG|RIFF|.{4}ftyp|%PDF", "a picture, a video or a document", "give the model's weights"),
)


def content_of(path: Path) -> Content:
    """What an existing file holds. Raises InputError saying what it is, if it is nothing that weights are read from."""
    with open_regular(path) as file:
        start = file.read(_START)
    if start[:2] == b"PK":
        return "zip"
    # Eight bytes with the length of the header, then the header, which is JSON and may be padded with spaces.
    if re.match(rb".{8}\s*\{", start, re.DOTALL) and int.from_bytes(start[:8], "little") < 2**32:
        return "safetensors"
    for mark, name, mend in _OTHERS:
        if re.match(mark, start, re.DOTALL):
            raise InputError(f"{path}: {name}; {mend}")
    if start.removeprefix(codecs.BOM_UTF8).lstrip()[:1] in (b"{", b"["):
        return "json"
    if not start:
        raise InputError(f"{path}: an empty file, truncated to nothing; {_AGAIN}")
    if not start.strip(b"\0"):
        raise InputError(f"{path}: begins with {len(start)} zeros, as after an interrupted download; {_AGAIN}")
    if len(start) < 16:
        raise InputError(f"{path}: holds {len(start)} bytes only, it is truncated or no checkpoint; {_AGAIN}")
    raise InputError(
        f"{path}: neither a file of torch.save (a zip archive) nor safetensors; it begins with {start[:16]!r}; give "
        "a model.safetensors or model.pt"
    )
