"""Files that a case names: each is read once, as a whole, and only up to a limited size.

A case may come from somebody else. A file that it names may be a device or a pipe, may unpack to a
million times its size, or may change while it is read. A message then says so before memory or time
is spent. The size that a packed file declares is checked before the file is unpacked. A digest is a
hash of a content. VTK's files are in XML, or in an older form ("legacy"), with lines of words and
counts.
"""

import hashlib
import io
import logging
import os
import re
import stat
import warnings
import zipfile
from errno import EFBIG, EINVAL, EISDIR
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyvista

MAX_FILE_BYTES = 500_000_000
MAX_UNPACKED_BYTES = 500_000_000  # of numbers that a packed file may declare
MAX_LINE_LENGTH = 10_000  # characters in a line of a table

# Declarations of sizes in the XML files and in the legacy files of VTK.
EXTENT = re.compile(rb"""\b(?:Whole)?Extent\s*=\s*["']([^"']*)["']""")
COUNT = re.compile(
    rb"""\bNumberOf(?:Points|Cells|Tuples|Verts|Lines|Strips|Polys)\s*=\s*["']\s*(\d+)"""
)
ARRAY_TAG = re.compile(rb"""<\s*(?:P?DataArray|Array)\b[^>]*""")
COMPONENTS = re.compile(rb"""\bNumberOfComponents\s*=\s*["']\s*(\d+)""")
LEGACY_GRID = re.compile(rb"^[ \t]*DIMENSIONS\s+(\d+)\s+(\d+)\s+(\d+)", re.M)
LEGACY = re.compile(
    rb"^[ \t]*(?:POINTS|POINT_DATA|CELL_DATA|[XYZ]_COORDINATES|CELLS|CELL_TYPES)\s+(\d+)", re.M
)
LEGACY_ARRAY = re.compile(rb"^[ \t]*\S+[ \t]+(\d+)[ \t]+(\d+)[ \t]+[a-z_]+[ \t]*\r?$", re.M)


def read_bounded(file: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a regular file, of the length that it has when it is opened.

    Raises
    ------
    OSError
        If the file cannot be read, is a folder, a device or a pipe, or has more than `max_bytes`
        bytes.
    """
    with open_regular(file) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > max_bytes:
            raise OSError(EFBIG, f"it is larger than {max_bytes} bytes", str(file))
        return stream.read(size)


def open_regular(file: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises
    ------
    OSError
        If the file cannot be read, or is a folder, a device or a pipe.
    """
    try:
        _refuse_special(file, file.stat().st_mode)  # to open some devices has effects
        # Without waiting for a writer.
        descriptor = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError:
        raise OSError(EINVAL, "its name has a zero byte", str(file)) from None
    stream = os.fdopen(descriptor, "rb")
    try:  # again: another file may have its name by now
        _refuse_special(file, os.fstat(descriptor).st_mode)
    except OSError:
        stream.close()
        raise
    return stream


def _refuse_special(file: Path, mode: int) -> None:
    """Raise an OSError if the mode of a file is that of a folder, a device or a pipe."""
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(EISDIR, os.strerror(EISDIR), str(file))
    if not stat.S_ISREG(mode):
        raise OSError(EINVAL, "it is a device or a pipe; copy its content into a file", str(file))


class Files:
    """Store of the contents of files, each as it was when it was first read.

    A case and all copies of it share one store. On several ranks it has what rank 0 has read.

    Attributes
    ----------
    contents
        File -> its content, or the error of reading it.
    shared
        Whether all ranks have the same contents.
    given
        Objects that a program gives in place of files, each with a `digest`.
    _digests
        File -> hash of its content, where it has been asked for.
    """

    def __eq__(self, other: object) -> bool:
        """Return True for any other store: contents are compared by their digests.

        So cases with equal keys are equal.
        """
        return isinstance(other, Files)

    __hash__ = object.__hash__

    def __init__(self) -> None:
        self.contents: dict[Path, bytes | OSError] = {}
        self.shared = False
        self.given: dict[Path, Any] = {}
        self._digests: dict[Path, str] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return this store itself: copies of a case share it."""
        return self

    def content(self, file: Path) -> bytes:
        """Return the content of a file, which is read at the first call.

        Raises
        ------
        OSError
            If the file cannot be read, is no regular file, or is too large; the same at each call.
        """
        if file not in self.contents:
            try:
                self.contents[file] = read_bounded(file)
            except OSError as e:  # kept, so that each call has the same result
                self.contents[file] = e
        content = self.contents[file]
        if isinstance(content, OSError):
            raise content.with_traceback(None)  # which would grow with each call
        return content

    def digest(self, file: Path) -> str | None:
        """Return a hash of the content of a file; None if it cannot be read."""
        if file in self.given:
            return str(self.given[file].digest)
        if file not in self._digests:
            try:
                self._digests[file] = hashlib.sha256(self.content(file)).hexdigest()
            except OSError:
                return None
        return self._digests[file]


def table_text(content: bytes) -> str:
    """Return the text of a table from the bytes of its file.

    Raises
    ------
    ValueError
        If a line is longer than any row of numbers.
    """
    # -sig: without the mark that some programs put at the begin
    text = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig", errors="replace").read()
    for line_number, line in enumerate(io.StringIO(text), 1):
        if len(line) > MAX_LINE_LENGTH:
            raise ValueError(f"line {line_number} has more than {MAX_LINE_LENGTH} characters")
    return text


def npz_arrays(content: bytes) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of numbers in the content of an .npz file, by name.

    Raises
    ------
    ValueError
        If it is none, has objects, or would unpack to more than `MAX_UNPACKED_BYTES` bytes.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            total = sum(_declared_bytes(archive, member) for member in archive.infolist())
        if total <= MAX_UNPACKED_BYTES:
            with np.load(io.BytesIO(content), allow_pickle=False) as npz:
                return {name: np.asarray(npz[name], dtype=float) for name in npz.files}
    except Exception as e:  # whatever is wrong in a zip file of arrays
        raise ValueError(f"is no .npz file of arrays of numbers: {e}") from None
    raise ValueError(f"its arrays have {total:.3g} bytes; allowed at most {MAX_UNPACKED_BYTES:.3g}")


def _declared_bytes(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> int:
    """Return the bytes that an array in an archive takes as floats, from its header alone.

    The result is at least the size that the archive declares for the array.
    """
    format_of_numpy: Any = np.lib.format
    with archive.open(member) as stream:
        version = format_of_numpy.read_magic(stream)
        if version == (1, 0):
            shape, _, dtype = format_of_numpy.read_array_header_1_0(stream)
        else:
            shape, _, dtype = format_of_numpy.read_array_header_2_0(stream)
    # arrays become floats of 8 bytes, but are first unpacked as they are
    return max(member.file_size, prod(map(int, shape)) * max(int(dtype.itemsize), 8))


def read_vtk(content: bytes, suffix: str) -> "pyvista.DataSet":
    """Return the data set in the content of a file, as VTK reads it.

    VTK's own messages about damaged files are suppressed. `suffix` is that of the file's name.

    Raises
    ------
    ValueError
        If the file declares more numbers than `MAX_UNPACKED_BYTES` bytes hold, or VTK cannot read
        it.
    """
    if (size := _vtk_declared_bytes(content)) > MAX_UNPACKED_BYTES:
        raise ValueError(
            f"declares {size:.3g} bytes of numbers; allowed at most {MAX_UNPACKED_BYTES:.3g}"
        )
    import pyvista  # VTK takes long to import
    from vtkmodules.vtkCommonCore import vtkObject

    # messages are switched off meanwhile, and back to what they were
    vtk_warnings = vtkObject.GetGlobalWarningDisplay()
    logging_level = logging.root.manager.disable
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        copied = Path(folder) / f"data{suffix}"
        copied.write_bytes(content)
        try:
            vtkObject.GlobalWarningDisplayOff()
            logging.disable()
            return pyvista.read(copied)
        except Exception as e:  # VTK and pyvista raise many types
            raise ValueError(str(e).replace(str(copied), "the file") or type(e).__name__) from None
        finally:
            logging.disable(logging_level)
            vtkObject.SetGlobalWarningDisplay(vtk_warnings)


def _vtk_declared_bytes(content: bytes) -> int:
    """Return the bytes of points and arrays that the headers in a VTK file declare.

    It is an upper estimate for XML files: each array counts as long as the longest.
    """
    # a legacy file: points and cells count as three floats each, fields as their width times count
    if b"<VTKFile" not in content[:4096]:
        counts = [prod(map(int, numbers)) for numbers in LEGACY_GRID.findall(content)]
        counts += [int(numbers) for numbers in LEGACY.findall(content)]
        fields = [int(width) * int(count) for width, count in LEGACY_ARRAY.findall(content)]
        return 8 * (3 * max(counts, default=0) + sum(fields))
    # an XML file: the points of structured grids, from first and last index in each direction
    points = [_points_in_extent(numbers) for numbers in EXTENT.findall(content)]
    max_count = max([*points, *(int(n) for n in COUNT.findall(content))], default=0)
    # components of each array; one where the tag does not say
    widths = [
        int(numbers[1]) if (numbers := COMPONENTS.search(tag)) else 1
        for tag in ARRAY_TAG.findall(content)
    ]
    return 8 * max_count * (3 + sum(widths))


def _points_in_extent(numbers: bytes) -> int:
    """Return the points of a grid from the text of first and last index in each direction."""
    extent = [int(n) for n in re.findall(rb"-?\d+", numbers)]
    return prod(abs(b - a) + 1 for a, b in zip(extent[::2], extent[1::2], strict=False))
