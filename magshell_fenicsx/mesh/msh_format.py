"""gmsh's mesh format, MSH 2 and 4, as text or binary, read without gmsh.

gmsh takes the kind of a file from its content and runs what is a script (SystemCall "..."), and also a file beside it,
called the same with .opt at its end. Here numbers and names are read, and nothing can run.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError

Integers = NDArray[np.int64]
Reals = NDArray[np.float64]
Kind = Literal["int", "size"]
Order = Literal["<", ">", ""]
TYPE = {"int": "i4", "size": "i8", "real": "f8"}  # of a binary file
DIMENSION = {"Point": 0, "Line": 1, "Triangle": 2, "Quadrilateral": 2}  # of all others 3
UP_TO_31 = (  # the number of nodes is in the name; I: incomplete
    "Line 2,Triangle 3,Quadrilateral 4,Tetrahedron 4,Hexahedron 8,Prism 6,Pyramid 5,Line 3,Triangle 6,Quadrilateral 9,"
    "Tetrahedron 10,Hexahedron 27,Prism 18,Pyramid 14,Point 1,Quadrilateral 8,Hexahedron 20,Prism 15,Pyramid 13,"
    "Triangle 9,Triangle 10,Triangle 12,Triangle 15,Triangle 15I,Triangle 21,Line 4,Line 5,Line 6,Tetrahedron 20,"
    "Tetrahedron 35,Tetrahedron 56"
)
FROM_36 = "Quadrilateral 16,Quadrilateral 25,Quadrilateral 36,Quadrilateral 12,Quadrilateral 16I,Quadrilateral 20"
TYPES = dict(enumerate(UP_TO_31.split(","), 1)) | dict(enumerate(FROM_36.split(","), 36))
TYPES |= {92: "Hexahedron 64", 93: "Hexahedron 125"}  # gmsh's number of a type of element -> its name
EARLY, MORE = "it ends too early", "it holds more than it says"
HEAD = re.compile(rb"\$(\w+)[ \t\r]*\n")


@dataclass(frozen=True)
class Block:
    """Elements of one type on one entity; (m, k) numbers of their nodes."""

    type: int
    entity: int
    nodes: Integers

    @property
    def name(self) -> str:
        return TYPES[self.type]

    @property
    def dimension(self) -> int:
        return _dimension(self.type)


@dataclass
class Content:
    """What a file holds.

    Attributes
    ----------
    tags, places
        Numbers (n,) and coordinates (n, 3) of the nodes.
    blocks
        Elements, in the order of the numbers of their entities.
    groups
        Dimension and number of an entity -> numbers of its physical groups.
    names
        Dimension and number of a physical group -> its name.
    """

    tags: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    places: Reals = field(default_factory=lambda: np.empty((0, 3)))
    blocks: list[Block] = field(default_factory=list)
    groups: dict[tuple[int, int], set[int]] = field(default_factory=dict)
    names: dict[tuple[int, int], str] = field(default_factory=dict)


def parsed(content: bytes) -> Content:
    """Read the content of a file.

    Raises
    ------
    MeshError
        If it is of another kind, or damaged.
    """
    found, at, version = Content(), 0, 0.0
    order: Order = ""
    while at < len(content.rstrip()):
        at = re.compile(rb"\s*").match(content, at).end()  # type: ignore[union-attr]  # it always matches
        head = HEAD.match(content, at)
        if not version and (not head or head[1] not in (b"MeshFormat", b"Comments")):
            raise MeshError(
                "is no mesh of gmsh's, which begins with $MeshFormat; allowed are versions 2 and 4, as text or binary. "
                "A script is not run here: gmsh -2 -o part.msh part.geo makes a mesh of it"
            )
        if not head:
            line = content.count(b"\n", 0, at) + 1
            raise MeshError(f"line {line} is outside of all sections; allowed are $Nodes ... $EndNodes and the like")
        name, at = head[1].decode(errors="replace"), head.end()
        try:
            read = SECTIONS_2.get(name) if version < 3 else SECTIONS.get(name)
            if name == "MeshFormat":
                version, order = _format(content, at)
            elif name == "PhysicalNames":
                found.names |= _names(content[at : _end(content, name, at)[0]])
            elif read:
                numbers = _Binary(content, at, order) if order else _Text(content[at : _end(content, name, at)[0]])
                read(numbers, version, found)
                at = numbers.finish(at)
            start, after = _end(content, name, at)
            if read and order and content[at:start].strip():
                raise ValueError(MORE)
        except (ValueError, KeyError, OverflowError) as e:
            if isinstance(e, MeshError):
                raise
            raise MeshError(f"the section ${name} is damaged: {e}") from None
        at = after
    found.blocks.sort(key=lambda block: block.entity)
    return found


def _end(content: bytes, name: str, at: int) -> tuple[int, int]:
    """Where the last line of a section begins and ends."""
    found = re.compile(rb"^[ \t]*\$End%s[ \t\r]*$" % name.encode(), re.MULTILINE).search(content, at)
    if not found:
        raise ValueError(f"$End{name} is missing")
    return found.span()


def _format(content: bytes, at: int) -> tuple[float, Order]:
    """Version, and the byte order of a binary file; "" of a text file."""
    line, _, rest = content[at : at + 200].partition(b"\n")
    words = line.split()
    version, binary = float(words[0]), words[1:2] == [b"1"]
    if not (2 <= version < 3 or version in (4.0, 4.1)):
        raise MeshError(
            f"is of version {version:g} of gmsh's format; allowed are 2 and 4: gmsh -save -format msh41 -o new.msh "
            "old.msh makes one of the other"
        )
    if words[2:3] != [b"8"]:
        raise ValueError("numbers must have 8 bytes")
    if not binary:
        return version, ""
    return version, "<" if rest[:4] == b"\x01\0\0\0" else ">"


def _names(body: bytes) -> dict[tuple[int, int], str]:
    lines = body.split(b"\n", 1)[1] if b"\n" in body else b""
    found = re.findall(rb'^[ \t]*([0-3])[ \t]+(-?\d+)[ \t]+"(.*)"[ \t\r]*$', lines, re.MULTILINE)
    return {(int(dim), int(tag)): name.decode("utf-8", "replace") for dim, tag, name in found}


class _Text:
    """The numbers of a section of a text file, one after the other."""

    def __init__(self, body: bytes) -> None:
        words = body.split()
        self._words, self._at = np.array(words).astype(np.float64) if words else np.empty(0), 0

    def reals(self, count: int) -> Reals:
        if not 0 <= count <= len(self._words) - self._at:
            raise ValueError(EARLY)
        self._at += count
        return self._words[self._at - count : self._at]

    def take(self, count: int, kind: Kind = "int") -> Integers:
        return _whole(self.reals(count))

    def table(self, count: int, width: int) -> Reals:
        return self.reals(count * width).reshape(count, width)

    def numbered(self, count: int, width: int) -> tuple[Integers, Reals]:
        """Rows of a whole number and so many others."""
        table = self.table(count, 1 + width)
        return _whole(table[:, 0]), table[:, 1:]

    def rest(self) -> Integers:
        return self.take(len(self._words) - self._at)

    def line(self) -> int:
        return int(self.take(1)[0])

    def finish(self, begun: int) -> int:
        """Where in the file to go on, after a section that begins there."""
        if self._at < len(self._words):
            raise ValueError(MORE)
        return begun


class _Binary:
    """The same of a binary file, from a position on."""

    def __init__(self, content: bytes, at: int, order: Order) -> None:
        self._content, self.at, self._order = content, at, order

    def take(self, count: int, kind: Kind = "int") -> Integers:
        return _whole(self._read(np.dtype(TYPE[kind]), count).astype(np.float64))

    def reals(self, count: int) -> Reals:
        return self._read(np.dtype(TYPE["real"]), count).astype(np.float64)

    def table(self, count: int, width: int) -> Reals:
        return self.reals(count * width).reshape(count, width)

    def numbered(self, count: int, width: int) -> tuple[Integers, Reals]:
        rows = self._read(np.dtype([("tag", TYPE["int"]), ("rest", TYPE["real"], (width,))]), count)
        return rows["tag"].astype(np.int64), rows["rest"].astype(np.float64)

    def _read(self, row: "np.dtype[Any]", count: int) -> NDArray[Any]:
        if not 0 <= count * row.itemsize <= len(self._content) - self.at:
            raise ValueError(EARLY)
        self.at += count * row.itemsize
        return np.frombuffer(self._content, row.newbyteorder(self._order or "="), count, self.at - count * row.itemsize)

    def line(self) -> int:
        """A number that is text here too."""
        line = self._content[self.at : self.at + 40].split(b"\n")[0]
        self.at += len(line) + 1
        return int(line)

    def finish(self, begun: int) -> int:
        return self.at


Numbers = _Text | _Binary


def _whole(x: Reals) -> Integers:
    if not (np.abs(x) < 2**53).all() or (x != np.rint(x)).any():
        raise ValueError("a number that must be whole is not, or is too large")
    return x.astype(np.int64)


def _entities(numbers: Numbers, version: float, found: Content) -> None:
    """The physical groups of each entity."""
    for dim, count in enumerate(numbers.take(4, "size")):
        for _ in range(count):
            (entity,) = numbers.take(1)
            _groups_of(numbers, version, found, dim, int(entity))


def _partitioned(numbers: Numbers, version: float, found: Content) -> None:
    _, ghosts = numbers.take(2, "size")
    numbers.take(2 * ghosts)
    for dim, count in enumerate(numbers.take(4, "size")):
        for _ in range(count):
            entity, _, _ = numbers.take(3)
            numbers.take(numbers.take(1, "size")[0])  # its partitions
            _groups_of(numbers, version, found, dim, int(entity))


def _groups_of(numbers: Numbers, version: float, found: Content, dim: int, entity: int) -> None:
    numbers.reals(3 if dim == 0 and version > 4 else 6)  # its box
    groups = numbers.take(numbers.take(1, "size")[0])
    if dim:
        numbers.take(numbers.take(1, "size")[0])  # its boundary
    found.groups.setdefault((dim, entity), set()).update(abs(int(group)) for group in groups)


def _nodes(numbers: Numbers, version: float, found: Content) -> None:
    parts: list[tuple[tuple[int, int], Integers, Reals]] = []
    for _ in range(numbers.take(2 if version < 4.1 else 4, "size")[0]):
        first, second, parametric = (int(n) for n in numbers.take(3))
        dim, entity = (first, second) if version > 4 else (second, first)
        count, width = int(numbers.take(1, "size")[0]), 3 + (dim if parametric else 0)
        if version > 4:
            tags, places = numbers.take(count, "size"), numbers.table(count, width)
        else:
            tags, places = numbers.numbered(count, width)
        parts.append(((dim, entity), tags, places[:, :3]))
    parts.sort(key=lambda part: part[0])
    _keep_nodes(found, [tags for _, tags, _ in parts], [places for _, _, places in parts])


def _nodes_2(numbers: Numbers, version: float, found: Content) -> None:
    tags, places = numbers.numbered(numbers.line(), 3)
    _keep_nodes(found, [tags], [places])


def _keep_nodes(found: Content, tags: list[Integers], places: list[Reals]) -> None:
    found.tags = np.concatenate([found.tags, *tags])
    found.places = np.concatenate([found.places, *places])
    if not np.isfinite(found.places).all():
        raise ValueError("a coordinate is not a number")
    if len(np.unique(found.tags)) != len(found.tags):
        raise ValueError("two nodes have one number")


def _elements(numbers: Numbers, version: float, found: Content) -> None:
    for _ in range(numbers.take(2 if version < 4.1 else 4, "size")[0]):
        first, second, kind = (int(n) for n in numbers.take(3))
        count, width = int(numbers.take(1, "size")[0]), 1 + _nodes_of(kind)
        table = numbers.take(count * width, "size" if version > 4 else "int").reshape(count, width)
        found.blocks.append(Block(kind, second if version > 4 else first, table[:, 1:]))


def _dimension(kind: int) -> int:
    return DIMENSION.get(TYPES[kind].split()[0], 3)


def _nodes_of(kind: int) -> int:
    if kind not in TYPES:
        raise MeshError(f"has elements of gmsh's type {kind}; allowed are triangles of order 1, 2 and 3")
    return int(TYPES[kind].split()[1].removesuffix("I"))


def _elements_2(numbers: Numbers, version: float, found: Content) -> None:
    """Of version 2: each with its first physical group and its entity; it stands there once for each of its groups."""
    count, rows = numbers.line(), dict[tuple[int, int], list[list[int]]]()
    for kind, tags, nodes in _text_rows(numbers, count) if isinstance(numbers, _Text) else _blobs(numbers, count):
        group, entity = (int(tags[0]), int(tags[1])) if len(tags) > 1 else (0, 1)
        rows.setdefault((kind, entity), []).append(nodes)
        if group:
            found.groups.setdefault((_dimension(kind), entity), set()).add(abs(group))
    for (kind, entity), each in rows.items():
        table = np.array(each, dtype=np.int64)
        first = np.unique(table, axis=0, return_index=True)[1]
        found.blocks.append(Block(kind, entity, table[np.sort(first)]))


def _text_rows(numbers: _Text, count: int) -> Iterator[tuple[int, list[int], list[int]]]:
    """Type, tags and nodes of each element."""
    words: Any = numbers.rest().tolist()
    at = 0
    for _ in range(count):
        if at + 3 > len(words):
            raise ValueError(EARLY)
        kind, tags = words[at + 1], words[at + 2]
        nodes, begin = _nodes_of(kind), at + 3 + tags
        at = begin + nodes
        if tags < 0 or at > len(words):
            raise ValueError(EARLY)
        yield kind, words[begin - tags : begin], words[begin:at]
    if at < len(words):
        raise ValueError(MORE)


def _blobs(numbers: _Binary, count: int) -> Iterator[tuple[int, list[int], list[int]]]:
    """The same; in a binary file elements of one type and number of tags stand together."""
    done = 0
    while done < count:
        kind, many, tags = (int(n) for n in numbers.take(3))
        if many < 1 or tags < 0:
            raise ValueError("a number in it is negative")
        table = numbers.take(many * (1 + tags + _nodes_of(kind))).reshape(many, -1)
        for row in list[list[int]](table.tolist()):
            yield kind, row[1 : 1 + tags], row[1 + tags :]
        done += many


SECTIONS = {"Entities": _entities, "PartitionedEntities": _partitioned, "Nodes": _nodes, "Elements": _elements}
SECTIONS_2 = {"Nodes": _nodes_2, "Elements": _elements_2}
