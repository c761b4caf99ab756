"""What a case names may be any file: each is read once, whole, and refused by one message before it
costs memory.
"""

import io
import os
import resource
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from command import importing_environment, magshell

import magshell_fenicsx as ms
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.platform.input_files import Files, read_bounded, table_text

DATA = """
shell: {{geometry: hemisphere, radius_to_thickness: 50, poisson_ratio: 0.3,
  imperfections: [{{kind: {kind}, file: "{file}"{more}}}]}}
boundary: {{equator: clamped}}
loading: {{kind: pressure, until: limit}}
"""
GRID = """
shell: {{geometry: plate, length: 20 mm, width: 5 mm, thickness: 0.2 mm, youngs_modulus: 1 MPa, \
poisson_ratio: 0.5}}
boundary: {{left: clamped}}
magnetic: {{remanent: {{flux_density: 100 mT}}, \
applied: {{sources: [{{kind: grid, file: "{file}"}}]}}}}
"""
MESH = """
shell: {{geometry: mesh, file: "{file}", radius: 1, thickness: 0.1, poisson_ratio: 0.3}}
boundary: {{edge: clamped}}
"""
KINDS = {
    "data": DATA.replace("{kind}", "data").replace("{more}", ""),
    "modes": DATA.replace("{kind}", "modes").replace("{more}", ", amplitudes: [0.1]"),
    "grid": GRID,
    "mesh": MESH,
}
VTI = (
    '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian">'
    '<ImageData WholeExtent="{0}" Origin="0 0 0" Spacing="1 1 1"><Piece Extent="{0}">'
    '<PointData><DataArray type="Float64" Name="B" NumberOfComponents="3" '
    'format="ascii">0 0 0</DataArray></PointData></Piece></ImageData></VTKFile>'
)
LEGACY = (
    "# vtk DataFile Version 3.0\nB\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS {0} {0} {0}\n"
    "ORIGIN 0 0 0\n"
)
LIMIT = 6 * 2**30  # bytes of addresses: far more than any message needs


def bomb(file: Path) -> None:
    """Arrays of 5.6 GB of zeros each in 17 MB: packed in parts of equal bytes."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name in ("x", "y", "z", "w0", "Bx", "By", "Bz"):
            head = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                head, {"descr": "<f8", "fortran_order": False, "shape": (700_000_000,)}
            )
            with archive.open(f"{name}.npy", "w") as stream:
                stream.write(head.getvalue() + bytes(10_000_000))


def lying(file: Path) -> None:
    """The archive is small, and so is what it declares; the head of its array is not."""
    with zipfile.ZipFile(file, "w") as archive, archive.open("x.npy", "w") as stream:
        shape = {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
        np.lib.format.write_array_header_1_0(stream, shape)


def scattered(file: Path) -> None:
    rows = np.random.default_rng(1).random((3000, 6))
    np.savetxt(file, rows, delimiter=",", header="x,y,z,Bx,By,Bz", comments="")


def wide(file: Path) -> None:
    file.write_text("x,y,z,w0,Bx,By,Bz\n" + "1," * 2_000_000 + "1\n", encoding="utf-8")


MADE = {
    "pipe.csv": os.mkfifo,
    "pipe.msh": os.mkfifo,
    "zero.csv": lambda file: file.symlink_to("/dev/zero"),
    "zero.vti": lambda file: file.symlink_to("/dev/zero"),
    "zero.msh": lambda file: file.symlink_to("/dev/zero"),
    "folder.csv": Path.mkdir,
    "bomb.npz": bomb,
    "lying.npz": lying,
    "wide.csv": wide,
    "scattered.csv": scattered,
    "huge.vti": lambda file: file.write_text(
        VTI.format("0 99999 0 99999 0 99999"), encoding="utf-8"
    ),
    "huge.vtk": lambda file: file.write_text(LEGACY.format(99999), encoding="utf-8"),
    "huge.vtu": lambda file: file.write_text(
        '<VTKFile type="UnstructuredGrid"><UnstructuredGrid>'
        '<Piece NumberOfPoints="9999999999" NumberOfCells="1">'
        '<Points><DataArray type="Float64" NumberOfComponents="3"/></Points>'
        "</Piece></UnstructuredGrid></VTKFile>",
        encoding="utf-8",
    ),
    "damaged.vti": lambda file: file.write_text(VTI.format("0 5 0 5 0 5")[:150], encoding="utf-8"),
}
SPECIAL = "cannot be read: it is a device or a pipe; copy its content into a file"
REFUSED = [
    ("data", "pipe.csv", SPECIAL),
    ("grid", "pipe.csv", SPECIAL),
    ("mesh", "pipe.msh", SPECIAL),
    ("data", "zero.csv", SPECIAL),
    ("grid", "zero.vti", SPECIAL),
    ("mesh", "zero.msh", SPECIAL),
    (
        "modes",
        "zero.vti",
        "is no mode file that a run writes (fields/mode_*.vtu): it is a device or a pipe",
    ),
    ("data", "folder.csv", "cannot be read: Is a directory"),
    ("data", "bomb.npz", "its arrays have 3.92e+10 bytes; allowed at most 5e+08"),
    ("grid", "bomb.npz", "its arrays have 3.92e+10 bytes; allowed at most 5e+08"),
    ("data", "lying.npz", "its arrays have 8e+12 bytes; allowed at most 5e+08"),
    ("data", "wide.csv", "line 2 has more than 10000 characters"),
    ("grid", "wide.csv", "line 2 has more than 10000 characters"),
    (
        "grid",
        "scattered.csv",
        "is no rectilinear grid of finite numbers: 3000 rows with 3000 x 3000 x 3000 different",
    ),
    ("grid", "huge.vti", "declares 4.8e+16 bytes of numbers; allowed at most 5e+08"),
    ("grid", "huge.vtk", "declares 2.4e+16 bytes of numbers; allowed at most 5e+08"),
    ("modes", "huge.vtu", "declares 4.8e+11 bytes of numbers; allowed at most 5e+08"),
    ("grid", "damaged.vti", "no vector B"),
    ("data", r"a\0b", "a file's name has no zero byte"),
    ("grid", r"a\0b", "a file's name has no zero byte"),
    ("mesh", r"a\0b", "a file's name has no zero byte"),
    ("data", "", ".file: '': the name is empty; give that of a file"),
    ("grid", "", ".file: '': the name is empty; give that of a file"),
]


def _refused(folder: Path) -> None:
    """In a process with little memory: print the message of each case."""
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT, LIMIT))
    for kind, name, _ in REFUSED:
        case = folder / "case.yaml"
        case.write_text(KINDS[kind].format(file=name), encoding="utf-8")
        start = time.process_time()
        try:
            make_problem(ms.Case.load(case))
            print(f"{kind} {name}: accepted", flush=True)
        except Exception as e:
            print(
                f"{type(e).__name__}: {str(e)!r}",
                f"{time.process_time() - start:.1f} s",
                flush=True,
            )


def test_files_that_are_refused(tmp_path: Path) -> None:
    """Each by one message of a user's error; VTK prints nothing beside it."""
    for name, make in MADE.items():
        make(tmp_path / name)
    environment = importing_environment()
    command = [sys.executable, __file__, str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=200, env=environment
    )
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert len(lines) == len(REFUSED)
    for (kind, name, said), line in zip(REFUSED, lines, strict=True):
        assert line.startswith(("CaseError: ", "InvalidCase: ", "MeshError: ")), (kind, name, line)
        assert said in line.replace("\\\\", "\\"), (kind, name, line)
        assert float(line.split()[-2]) < 5, (kind, name, line)  # the bomb alone would take a minute


@pytest.mark.parametrize("name", ["pipe.csv", "zero.csv", "folder.csv"])
def test_a_case_that_is_no_file(tmp_path: Path, name: str) -> None:
    MADE[name](tmp_path / name)  # type: ignore[operator]
    done = magshell("check", tmp_path / name)
    assert done.returncode == 2
    assert done.stderr.startswith(f"{tmp_path / name}: cannot be read: ")
    assert done.stderr.count("\n") == 1


def test_what_is_read_stays(tmp_path: Path) -> None:
    """A copy of a case, and what is planned of it later, has the content of the first time."""
    case, file = tmp_path / "case.yaml", tmp_path / "places.csv"
    case.write_text(KINDS["data"].format(file="places.csv"), encoding="utf-8")
    file.write_text("x,y,z,w0\n1,2,3,4\n", encoding="utf-8")
    read = ms.Case.load(case)
    first = read.outside
    file.write_text("another", encoding="utf-8")
    assert read.outside == read.model_copy(deep=True).outside == first != ms.Case.load(case).outside


def test_limits(tmp_path: Path) -> None:
    """A file at the limit is read, as it was when it was opened; one byte more is refused, and so
    is a zero byte.
    """
    (tmp_path / "ten").write_bytes(b"0123456789")
    assert read_bounded(tmp_path / "ten", 10) == b"0123456789"
    with pytest.raises(OSError, match="it is larger than 9 bytes"):
        read_bounded(tmp_path / "ten", 9)
    with pytest.raises(OSError, match="its name has a zero byte"):
        Files().content(Path("a\0b"))
    assert table_text(b"\xef\xbb\xbfx,y\r\n1,2\r3,4") == "x,y\n1,2\n3,4"


if __name__ == "__main__":
    _refused(Path(sys.argv[1]))
