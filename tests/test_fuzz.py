"""Mutated case files are refused with a message, or work. None ends in a traceback or hangs."""

import time
import traceback
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis.configuration import set_hypothesis_home_dir
from mutations import case_files
from typer.testing import CliRunner

from magshell_fenicsx.cli import app

CHECK_LIMIT, RUN_LIMIT = (
    20.0,
    30.0,
)  # seconds: of `check`, and of `run` with a time limit of RUN_TIME
RUN_TIME = 1.0
COUNT, RUNS = 100, 3  # always the same mutations
COARSE = ["--set", "mesh.degree=4", "--set", "mesh.refinement=0.2"]


def invoke(*arguments: str, limit: float) -> int:
    """The exit code of a command that must end in time, without a traceback and with a message if
    it fails.

    One that is late runs again: what it compiled is then known.
    """
    for _ in range(2):
        start = time.perf_counter()
        done = CliRunner().invoke(app, list(arguments))
        raised = "".join(traceback.format_exception(done.exception))
        assert done.exception is None or isinstance(done.exception, SystemExit), raised
        late = time.perf_counter() - start >= limit
        if not late:
            break
    assert not late
    assert "Traceback" not in done.output
    assert done.output.strip()
    return done.exit_code


def test_mutated_case_files_are_refused_or_work(tmp_path: Path) -> None:
    """`magshell check` ends with 0 or 2; what it accepts, `magshell run` ends with 0, 2 or 3
    (`RUNS` of them).
    """
    set_hypothesis_home_dir(tmp_path)
    file, codes, accepted = tmp_path / "case.yaml", Counter[int](), dict[bytes, None]()

    @settings(
        max_examples=COUNT,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=HealthCheck,
    )
    @given(case_files())
    def check(content: bytes) -> None:
        file.write_bytes(content)
        code = invoke("check", str(file), limit=CHECK_LIMIT)
        assert code in (0, 2)
        codes[code] += 1
        if code == 0:
            accepted[content] = None

    check()
    assert min(codes[0], codes[2]) > COUNT / 20, (
        "the mutations are too wild or too tame to show anything"
    )
    step = max(1, len(accepted) // RUNS)
    for content in list(accepted)[::step]:
        file.write_bytes(content)
        out = str(tmp_path / "out")
        code = invoke(
            "run",
            str(file),
            "--out",
            out,
            "--overwrite",
            "--time-limit",
            str(RUN_TIME),
            *COARSE,
            limit=RUN_LIMIT,
        )
        assert code in (0, 2, 3), content


ABSURD = [
    ("shell.radius_to_thickness=1e9", "less than or equal to 100000"),
    (
        "shell.radius_to_thickness=1e4 & mesh={refinement: 20, degree: 5}",
        "GB are free: lower mesh.refinement",
    ),
    (
        "shell={geometry: strip, radius_to_thickness: 1e5, poisson_ratio: 0, width: 1e-5}",
        "unknowns",
    ),
    (
        "shell={geometry: strip, radius_to_thickness: 100, poisson_ratio: 0, width: 1e-5}",
        "narrower than its thickness",
    ),
    ("shell.defect={kind: dimple, amplitude: 50, width: 1}", "radii deep"),
    ("shell.defect={kind: dimple, amplitude: 6, width: 0.1}", "steepest slope"),
    ("shell.defect={kind: dimple, amplitude: 1, width: 50}", "half-width"),
    ("shell.youngs_modulus=9**9**9 Pa", "not a number with a unit"),
    ("magnetic={lambda_m: 1e-300}", "allowed are 0 and"),
    (
        (
            "magnetic={lambda_m: 1, remanent: {kind: expression, "
            "components: ['1/x', '0', '9**9**9**9']}}"
        ),
        "no finite value",
    ),
    (
        "magnetic={lambda_m: 1, remanent: {kind: expression, components: ['sin()', '0', '0']}}",
        "allowed are numbers",
    ),
    (
        "magnetic={lambda_m: 1, remanent: {kind: patches, patches: {rest: {polr: 1}}}}",
        "did you mean polar?",
    ),
    (
        "magnetic={lambda_m: 1, remanent: {kind: layers, layers: [{fraction: 1, polr: 1}]}}",
        "did you mean polar?",
    ),
    ("magnetic={lambda_m: 1, remanent: {polr: 3}}", "did you mean polar?"),
    ("magnetic={lambda_m: 1, remanent: {kind: patches, patches: {}}}", "needs the patch rest"),
    (
        "loading={kind: pressure, until: target, pressure: x, volume_change: 1}",
        ": loading.pressure: 'x'",
    ),
    (
        "loading={kind: indentation, at: {polar: 0.01}, depth: 1}",
        "more than a thickness from the pole",
    ),
    (
        "loading={kind: indentation, at: {polar: 45}, depth: 1, patch: 90}",
        "where it reaches the edge",
    ),
    ("loading=" + "[" * 2000, "nested too deeply"),
    ("loading=&a [*a]", "does an alias hold itself?"),
    ("loading=!!timestamp x", "not valid YAML"),
    ("loading=0x" + "f" * 5000, "thousands of digits"),
]


@pytest.mark.parametrize(("setting", "said"), ABSURD, ids=[setting[:40] for setting, _ in ABSURD])
def test_what_cannot_be_built_is_refused_with_a_reason(
    tmp_path: Path, setting: str, said: str
) -> None:
    file = tmp_path / "case.yaml"
    boundary = "{root: clamped}" if "strip" in setting else "{equator: clamped}"
    file.write_text(
        "shell: {geometry: hemisphere, radius_to_thickness: 90, poisson_ratio: 0.5}\n"
        f"boundary: {boundary}\nsymmetry: half\n",
        encoding="utf-8",
    )
    done = CliRunner().invoke(
        app, ["check", str(file), *(f"--set={s}" for s in setting.split(" & "))]
    )
    assert (done.exit_code, said in done.output) == (2, True), done.output


@pytest.mark.parametrize(
    ("start", "repeated"),
    [(b"\xff", b""), (b"a: &b [", b"*b,"), (b"#", b"#"), (b"\t", b""), (b"", b"")],
)
def test_what_is_no_case_file(tmp_path: Path, start: bytes, repeated: bytes) -> None:
    content = start + 1_000_000 * repeated
    file = tmp_path / "case.yaml"
    file.write_bytes(content)
    done = CliRunner().invoke(app, ["check", str(file)])
    assert done.exit_code == 2
    assert done.output.startswith(str(file))
