"""Journals on disk: elements in their order, each on disk before the next is computed.

An element (a frame) of the file is a mark, a length, a checksum and the content. The content of
most elements is a line of JSON and the values of vectors. A killed run may leave a part of the last
element, which is cut off.
"""

import json
import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.store.durable import AppendedFile, open_result

Array = NDArray[np.float64]
FRAME_HEAD = struct.Struct("<4sQI")  # mark, length and checksum of the content
MARK = b"MSF1"


class JournalFile:
    """File whose elements are read in their order; after the last one further ones are appended.

    Parameters
    ----------
    file
        An existing journal.

    `_reading` is the file as it is read. `_writing` is the file as it is appended to; None before
    the first element is appended.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._reading = file, open_result(file)
        self._writing: AppendedFile | None = None

    def next_content(self) -> bytes | None:
        """Return the content of the next element; None at the end, or at an incomplete element."""
        return read_frame(self._reading)

    def append(self, content: bytes) -> None:
        """Append an element; the first time, cut off what follows the last one that was read.

        Raises
        ------
        OSError
            With the file's name; the file still ends with a complete element.
        """
        if self._writing is None:
            self._writing = AppendedFile(self._file, self._reading.tell())
        self._writing.append(framed(content))

    def close(self) -> None:
        """Close the file, whose last elements are then on disk."""
        self._reading.close()
        if self._writing:
            self._writing.close()


def encoded(head: Mapping[str, Any], *vectors: Array) -> bytes:
    """Return the content of an element: a line of JSON, then the values of vectors.

    Examples
    --------
    >>> decoded(encoded({"mu": 0.1}, np.ones(2), np.zeros(1)))
    ({'mu': 0.1}, array([1., 1., 0.]))
    """
    text = json.dumps(head, default=_python_number)
    return b"\n".join([text.encode(), b"".join(vector.tobytes() for vector in vectors)])


def decoded(content: bytes) -> tuple[dict[str, Any], Array]:
    """Return the JSON object of an element, and the values of all its vectors in one array."""
    text, _, data = content.partition(b"\n")
    return json.loads(text), np.frombuffer(data)


def _python_number(number: Any) -> Any:
    """Return a number of NumPy as one of Python, which JSON can write."""
    return number.item()


def framed(content: bytes) -> bytes:
    """Return one element of the file as bytes: mark, length and checksum, then its content.

    Examples
    --------
    >>> import io
    >>> file = io.BytesIO(framed(b"whole") + framed(b"torn by a kill")[:-1])
    >>> read_frame(file), read_frame(file), file.tell()
    (b'whole', None, 21)
    """
    return FRAME_HEAD.pack(MARK, len(content), zlib.crc32(content)) + content


def read_frame(stream: BinaryIO) -> bytes | None:
    """Return the content of the element at the stream's position, and go on to the next one.

    None if there is no complete element with a right checksum; the position is then unchanged.
    """
    start = stream.tell()
    head = stream.read(FRAME_HEAD.size)
    if len(head) == FRAME_HEAD.size:
        mark, length, checksum = FRAME_HEAD.unpack(head)
        end = stream.seek(0, os.SEEK_END)
        content_start = stream.seek(start + FRAME_HEAD.size)
        # a damaged length may be any number
        if mark == MARK and length <= end - content_start:
            content = stream.read(length)
            if zlib.crc32(content) == checksum:
                return content
    stream.seek(start)
    return None
