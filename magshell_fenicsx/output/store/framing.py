"""A sequence of byte strings in one file, each with its length and checksum."""

import os
import struct
import zlib
from typing import BinaryIO

HEAD = struct.Struct("<4sQI")  # mark, length and checksum of the content
MARK = b"MSF1"


def framed(content: bytes) -> bytes:
    """The bytes to append for one element.

    Examples
    --------
    >>> import io
    >>> file = io.BytesIO(framed(b"whole") + framed(b"torn by a kill")[:-1])
    >>> read_frame(file), read_frame(file), file.tell()
    (b'whole', None, 21)
    """
    return HEAD.pack(MARK, len(content), zlib.crc32(content)) + content


def read_frame(stream: BinaryIO) -> bytes | None:
    """The element at the stream's position; None, with the position unchanged, if there is no complete one."""
    start = stream.tell()
    head = stream.read(HEAD.size)
    if len(head) == HEAD.size:
        mark, length, checksum = HEAD.unpack(head)
        left = stream.seek(0, os.SEEK_END) - stream.seek(start + HEAD.size)  # a damaged length may be any number
        if mark == MARK and length <= left and zlib.crc32(content := stream.read(length)) == checksum:
            return content
    stream.seek(start)
    return None
