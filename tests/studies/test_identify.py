"""Parameters from measured data: what was put in is found, bands cover it; resume, and what is
refused.
"""

import itertools
import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell
from conftest import CAP, STRIP
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

import magshell_fenicsx as ms
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.input.tables import read_rows
from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.simulate.readings import Reading, read
from magshell_fenicsx.studies.identify.laplace import Measured, fit_posterior

Array = NDArray[np.float64]
LOOKED_FOR = """
identify:
  parameters: {shell.youngs_modulus: {}, magnetic.remanent.polar: {}}
  candidates:
    - {of: tip_ux_mm, at: 20 mT, noise: 0.05 mm}
    - {of: tip_uz_mm, at: 1 mT, noise: 0.05 mm}
"""
COARSE = STRIP.replace("degree: 3, refinement: 0.5", "degree: 2, refinement: 0.3")
AT = "applied [mT],tip_uz [mm]\n"
SLIPS = {  # rows below that header -> what is said; lines are those of the file
    "5,9\n\n10,abc\n": r"measured.csv: line 4: tip_uz \[mm\]: abc: is no number",
    "5,9\nnan,12\n": "line 3: applied: has a row without a number",
    "5,9\n10,1e300\n": r"line 3: tip_uz: 1e\+300: allowed are numbers up to 1e\+30",
    "5,9\n10,inf\n": "line 3: tip_uz: inf: allowed are numbers up to",
    "5,9\n10\n": "has 2 names in its header and 1 columns in line 3",
    "5,9\n10,1,2\n": "has 2 names in its header and 3 columns in line 3",
    "": "has no rows of numbers below a header with the names of its columns",
}
KEYS = ("shell.youngs_modulus", "magnetic.remanent.polar")
TRUTH = np.array([900.0, 80.0])  # kPa, degrees
FIELDS = (3.0, 7.0, 11.0, 15.0, 19.0)  # mT
FEW = FIELDS[::2]
NOISE = 0.05  # mm


def case_file(folder: Path, text: str = COARSE + LOOKED_FOR) -> Path:
    file = folder / "strip.yaml"
    file.write_text(text)
    return file


def data_file(folder: Path, text: str) -> Path:
    file = folder / "measured.csv"
    file.write_text(text)
    return file


def readings(fields: tuple[float, ...] = FIELDS) -> list[Reading]:
    return [Reading(of, at) for at in fields for of in ("tip_ux_mm", "tip_uz_mm")]


def synthetic(folder: Path, text: str = COARSE + LOOKED_FOR, seed: int = 1) -> Path:
    """What the case itself gives, with noise; the heights in micrometres."""
    exact = read(ms.Scene(ms.Case.load(case_file(folder, text))), readings(FEW), []).values
    noisy = (exact + NOISE * np.random.default_rng(seed).normal(size=exact.size)).reshape(-1, 2)
    rows = [f"{b},{x!r},{1e3 * z!r}" for b, (x, z) in zip(FEW, noisy.tolist(), strict=True)]
    return data_file(folder, "\n".join(["applied [mT],tip_ux [mm],tip_uz [um]", *rows]) + "\n")


ELSEWHERE = ["shell.youngs_modulus=930 kPa", "magnetic.remanent.polar=78"]  # where the fit starts


@dataclass(frozen=True)
class Whole:
    """An identification by the command line that nobody interrupted: its words, and what it
    printed.
    """

    words: list[str | Path]
    out: Path
    stdout: str

    @property
    def content(self) -> dict[str, Any]:
        return dict(json.loads((self.out / "identify.json").read_text()))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    folder = tmp_path_factory.mktemp("whole")
    words = ["identify", case_file(folder), "--data", synthetic(folder)]
    words += [word for setting in ELSEWHERE for word in ("--set", setting)]
    done = magshell(*words, "--out", folder / "out")
    assert done.returncode == 0, done.stderr
    return Whole(words, folder / "out", done.stdout)


def test_what_was_put_in_is_found(whole: Whole) -> None:
    """Within three deviations; the columns estimate the noise that was added; the folder has what
    is said.
    """
    content, out = whole.content, whole.out
    found = [content["parameters"][key] for key in KEYS]
    away = [
        (each["value"] - truth) / each["deviation"]
        for each, truth in zip(found, TRUTH, strict=True)
    ]
    assert np.abs(away).max() < 3
    assert [each["unit"] for each in found] == ["kPa", ""]
    assert [content["noise"][of]["estimated"] for of in ("tip_ux", "tip_uz")] == [True, True]
    assert content["noise"]["tip_uz"]["deviation"] == pytest.approx(
        NOISE, rel=0.8
    )  # of two degrees of freedom
    assert (
        content["next"]["result"] == "tip_uz_mm"
    )  # there modulus and angle act otherwise than in the data
    assert all(
        "value" in each for each in content["predicted"]
    )  # none is lost between the points of the path
    assert (out / "identify.png").stat().st_size > 10_000
    rows = (out / "identify.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * len(FEW)
    assert "next: tip_uz_mm at 1 narrows" in whole.stdout
    falling = [float(each) for each in re.findall(r"^ +\d+  noise of .* tip_uz (\S+),",
                                                  whole.stdout, re.MULTILINE)]  # fmt: skip
    assert falling[-1] < falling[0]
    assert "misfit" not in whole.stdout  # it is a constant of the numbers of data and parameters
    for key, each in zip(KEYS, found, strict=True):
        band = f", 95 % between {each['low']:.6g} and {each['high']:.6g}"
        assert f"{key} = {each['value']:.6g} {each['unit']}".rstrip() + band in whole.stdout


class Killed(Exception):
    pass


def test_an_interrupted_identification_goes_on(whole: Whole, tmp_path: Path) -> None:
    """The same numbers, and no evaluation twice: killed as it begins, it goes on from all points
    but the last two.
    """
    _, file, _, data, *_ = whole.words
    out = tmp_path / "out"

    def killed(line: str) -> None:
        raise Killed

    with pytest.raises(Killed):
        ms.identify(file, data, ELSEWHERE, out, say=killed)
    for point in sorted(
        (whole.out / "points").glob("*.json"), key=lambda each: each.stat().st_mtime_ns
    )[:-2]:
        shutil.copy(point, out / "points")
    kept = {each: each.stat().st_mtime_ns for each in (out / "points").glob("*.json")}
    assert len(kept) >= 2
    again = ms.identify(file, data, ELSEWHERE, out)
    assert {each: each.stat().st_mtime_ns for each in kept} == kept
    assert again.parameters == whole.content["parameters"]
    assert again.content["evaluations"] == whole.content["evaluations"] - len(kept)


@pytest.mark.slow
def test_rows_of_several_cases_and_ends_of_paths(tmp_path: Path) -> None:
    """Buckling pressures in two fields give a cap's modulus and remanence, exact without noise."""
    text = CAP + "symmetry: axisymmetric\n"
    text += (
        "identify: {parameters: {shell.youngs_modulus: {}, magnetic.remanent.flux_density: {}}}\n"
    )
    text = text.replace("parameters:", "noise: {buckling_pressure_Pa: 0.5 Pa}, parameters:")
    file, key = case_file(tmp_path, text), "magnetic.applied.flux_density"
    rows = [f"{key} [mT],buckling_pressure [Pa]"]
    for field in (-10, 20):
        case = ms.Case.load(file, [f"{key}={field} mT"])
        pressure = read(ms.Scene(case), [Reading("buckling_pressure_Pa")], []).values[0]
        rows.append(f"{field},{float(pressure)!r}")
    start = ["shell.youngs_modulus=1.35 MPa", "magnetic.remanent.flux_density=57 mT"]
    found = ms.identify(file, data_file(tmp_path, "\n".join(rows)), start, tmp_path / "out")
    assert found.fit.x == pytest.approx([1.3, 60.0], rel=1e-4)
    assert found.content["rows"][1]["settings"] == f"{key}=20.0 mT"


class Interpolated:
    """Predictions of the strip by Chebyshev polynomials in both parameters, from runs at their
    points.
    """

    LOW, HIGH, DEGREE = np.array([820.0, 76.0]), np.array([980.0, 84.0]), 4

    def __init__(self, folder: Path) -> None:
        self.case = ms.Case.load(case_file(folder))
        nodes = np.cos((np.arange(self.DEGREE + 1) + 0.5) * np.pi / (self.DEGREE + 1))
        at = list(itertools.product(nodes, nodes))
        values = np.array(
            [self.exact(self.LOW + (np.array(z) + 1) / 2 * (self.HIGH - self.LOW)) for z in at]
        )
        self._c = np.linalg.solve(
            chebyshev.chebvander2d(*np.array(at).T, [self.DEGREE] * 2), values
        )
        self._c = self._c.reshape(self.DEGREE + 1, self.DEGREE + 1, -1)

    def exact(self, x: Array) -> Array:
        changed = {KEYS[0]: float(1e3 * x[0]), KEYS[1]: float(x[1])}
        return read(ms.Scene(self.case.problem().with_values(changed)), readings(), []).values

    def values(self, x: Array) -> Array:
        """(n, ...) at parameters (2, ...)."""
        low, high = (each.reshape(-1, *[1] * (x.ndim - 1)) for each in (self.LOW, self.HIGH))
        return chebyshev.chebval2d(*(2 * (x - low) / (high - low) - 1), self._c)

    def __call__(self, x: Array) -> tuple[Array, Array]:
        scale = 2 / (self.HIGH - self.LOW)
        z = (np.asarray(x) - self.LOW) * scale - 1
        by = [
            chebyshev.chebval2d(*z, scale[i] * chebyshev.chebder(self._c, axis=i)) for i in range(2)
        ]
        return self.values(np.asarray(x)), np.stack(by, axis=1)


@pytest.mark.slow
def test_bands_of_200_repeats_and_a_posterior(tmp_path: Path) -> None:
    """Of 200 synthetic measurements 92 to 98 % of the bands cover the truth; one posterior, summed
    on a grid, to 5 %.

    Runs are interpolated; the interpolation is 1e-4 of the noise, its slopes are those of the
    adjoints.
    """
    model = Interpolated(tmp_path)
    beside = np.array([871.0, 81.7])
    assert model(beside)[0] == pytest.approx(model.exact(beside), abs=1e-4 * NOISE)
    scene = ms.Scene(model.case)
    slopes = read(scene, readings(), KEYS).slopes * [1e3, 1.0]
    assert model(TRUTH)[1] == pytest.approx(slopes, rel=1e-3, abs=1e-6)
    y, group = model(TRUTH)[0], np.tile([0, 1], len(FIELDS))
    rng, inside, fits = np.random.default_rng(7), list[Array](), list[Array]()
    for _ in range(200):
        known = Measured(
            y + NOISE * rng.normal(size=y.size), group, np.full(2, NOISE), TRUTH, np.full(2, np.inf)
        )
        fit = fit_posterior(model, known, np.array([940.0, 78.0]), TRUTH, 20, lambda *_: None)
        inside.append((fit.band[0] < TRUTH) & (fit.band[1] > TRUTH))
        fits.append(fit.x)
    cover = np.mean(inside, axis=0)
    assert (cover >= 0.92).all()
    assert (cover <= 0.98).all()
    bias = (np.mean(fits, axis=0) - TRUTH) / (np.std(fits, axis=0) / np.sqrt(200))
    assert np.abs(bias).max() < 3
    axes = [np.linspace(-6, 6, 121) * fit.deviation[i] + fit.x[i] for i in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"))
    misfit = np.sum(((known.data[:, None, None] - model.values(grid)) / NOISE) ** 2, axis=0)
    weight = np.exp((misfit.min() - misfit) / 2)
    weight /= weight.sum()
    mean = np.sum(weight * grid, axis=(1, 2))
    assert (np.abs(mean - fit.x) < 0.05 * fit.deviation).all()
    deviation = np.sqrt(np.sum(weight * (grid - mean[:, None, None]) ** 2, axis=(1, 2)))
    assert deviation == pytest.approx(fit.deviation, rel=0.05)


@pytest.mark.slow
def test_the_posterior_of_emcee(tmp_path: Path) -> None:
    """Means and standard deviations within 5 %, where emcee (Foreman-Mackey and others 2013) is
    installed.
    """
    emcee = pytest.importorskip("emcee")
    model, rng = Interpolated(tmp_path), np.random.default_rng(3)
    data, group = (
        model(TRUTH)[0] + NOISE * rng.normal(size=2 * len(FIELDS)),
        np.tile([0, 1], len(FIELDS)),
    )
    known = Measured(data, group, np.full(2, NOISE), TRUTH, np.full(2, np.inf))
    fit = fit_posterior(model, known, np.array([940.0, 78.0]), TRUTH, 20, lambda *_: None)
    logarithm = lambda x: -float(np.sum(((data - model(x)[0]) / NOISE) ** 2)) / 2  # noqa: E731
    np.random.seed(5)  # noqa: NPY002  emcee's own generator
    sampler = emcee.EnsembleSampler(16, 2, logarithm)
    sampler.run_mcmc(fit.x + fit.deviation * rng.normal(size=(16, 2)), 3000)
    samples = sampler.get_chain(discard=200, flat=True)
    assert (np.abs(samples.mean(axis=0) - fit.x) < 0.05 * fit.deviation).all()
    assert samples.std(axis=0) == pytest.approx(fit.deviation, rel=0.05)


@pytest.mark.parametrize(
    ("data", "settings", "said"),
    [
        (
            "applied [mT],tip_uz [mm]\n5,9\n30,14\n10,12\n",
            [],
            (
                r"data: --data .*measured.csv: line 3: applied_mT = 30 is outside the path, "
                r"which goes from 0"
            ),
        ),
        (
            "applied [mT],tip_uz [mm]\n\n5,9\n\n-3,1\n10,12\n",
            [],
            r"line 5: applied_mT = -3 is outside the path",
        ),
        ("applied [mT],tip_uz\n5,9\n", [], r"tip_uz: has no unit: write tip_uz \[mm\]"),
        ("applied,tip_uz [mm]\n5,9\n", [], r"applied: has no unit: write applied \[mT\]"),
        ("applied [mT],tip_uz [s]\n5,9\n", [], "column tip_uz: its unit s"),
        (
            "applied [mT],tip_uz [mm]\n5,9\n",
            [],
            "1 data do not determine 2 parameters without a prior",
        ),
        (
            "applied [mT],tip_uz [mm]\n5,9\n10,12\n",
            [],
            "2 data do not say the noise beside 2 parameters",
        ),
        (
            "applied [mT],middle [mm]\n5,9\n",
            [],
            "middle: has the unit mm, but no result of this name has one",
        ),
        ("applied [mT],speed\n5,9\n", [], "speed: has no gradient here; allowed are"),
        ("applied [mT]\n5\n9\n", [], "has no column with a result of this case"),
        (
            "applied [mT],tip_uz [mm]\n5,9\n10,12\n15,13\n",
            [
                "identify.parameters={shell.youngs_modulus: {}, shell.density: {}}",
                "shell.density=1000 kg/m^3",
            ],
            "shell.density: has no influence on these data",
        ),
        (
            "applied [mT],tip_uz [mm]\n5,9\n10,12\n15,13\n",
            ["identify.parameters={shell.youngs_modulus: {}, magnetic.remanent.flux_density: {}}"],
            (
                "shell.youngs_modulus and magnetic.remanent.flux_density cannot be told apart "
                "by these data"
            ),
        ),
        (
            "applied [mT],tip_uz [mm]\n5,9\n",
            ["identify.parameters={shell.youngs_modulus: {prior: 900, deviation: 10 kPa}}"],
            "900: the case gives shell.youngs_modulus with the unit kPa: so has its prior",
        ),
        (
            "applied [mT],tip_uz [mm]\n5,9\n",
            ["identify.noise={tip_ux: 1 mm}"],
            "tip_ux: .*has no such column",
        ),
        (
            "applied [mT],tip_uz [mm]\n5,9\n",
            ["identify.noise={tip_uz: 1}"],
            "needs a unit, such as 1 mm",
        ),
        (
            "applied [mT],tip_uz [mm]\n5,9\n",
            ["identify.narrow=shell.thickness"],
            "is none of the parameters",
        ),
        (
            "applied [mT],tip_uz [mm]\n5,9\n",
            ["identify.parameters={mesh.size: {}}"],
            "identify.parameters.mesh.size: mesh.size: is no number that the case gives",
        ),
        ("applied [mT],tip_uz [mm]\n5,9\n", ["identify=null"], "identify: is missing"),
        (
            "shell.youngs_modulus [kPa],applied [mT],tip_uz [mm]\n900,5,9\n900,10,12\n900,15,13\n",
            [],
            "shell.youngs_modulus: is a column of the data, so it is known",
        ),
        *[(f"{AT}{rows}", [], said) for rows, said in SLIPS.items()],
        ("applied [mT],tip_uz [mm],tip_uz [um]\n5,9,9000\n", [], "has a column twice: applied"),
        (
            "applied [mT],tip_uz [mm],tip_uz_mm\n5,9,9\n",
            [],
            "tip_uz and tip_uz_mm are one measurement in two columns: leave one out",
        ),
        (
            "applied [mT],applied_mT,tip_uz [mm]\n5,5,9\n",
            [],
            "applied and applied_mT are one measurement in two columns",
        ),
        (
            "applied [mT],w_over_h,w [mm]\n5,-1,-0.8\n",
            [],
            "w_over_h and w are one measurement in two columns",
        ),
        (
            "hertz_1 [Hz],omega2_1,shell.thickness [mm]\n10,1e-3,0.8\n",
            ["shell.density=1100 kg/m^3"],
            "hertz_1 and omega2_1 are one measurement in two columns",
        ),
        (
            f"{AT}5,9\n",
            ["identify.parameters={shell.youngs_modulus: {prior: -1 kPa, deviation: 1 kPa}}"],
            "youngs_modulus.prior: .*'-1 kPa': must be greater than or equal to 1",
        ),
        (
            f"{AT}5,9\n",
            ["identify.noise={tip_uz: 1e-300 mm}"],
            "identify.noise.tip_uz: 1e-300 mm: allowed are numbers from 1e-30 to 1e",
        ),
    ],
)
def test_what_identifies_nothing(tmp_path: Path, data: str, settings: list[str], said: str) -> None:
    with pytest.raises(CaseError, match=said):
        ms.identify(case_file(tmp_path), data_file(tmp_path, data), settings, tmp_path / "out")


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        (
            "identify.parameters={shell.nope: {}}",
            "identify.parameters.shell.nope: shell.nope: the case has no such key",
        ),
        ("identify.candidates.0.of=nope", "identify.candidates.0.of: nope: has no gradient here"),
        ("identify.candidates.1.noise=0.05", "identify.candidates.1.noise: 0.05: needs a unit"),
        (
            "identify.changes=[tip_uz_cm]",
            "identify.changes: tip_uz_cm: the case has no such result",
        ),
        ("identify.noise={nope: 1 mm}", "identify.noise: nope: the case has no such result"),
        ("identify.noise={tip_ux: 1 mm, tip_uz_mm: 1 mm}", ""),
    ],
)
def test_check_looks_at_the_section(tmp_path: Path, setting: str, said: str) -> None:
    """What needs no data is found by `magshell check`."""
    done = magshell("check", case_file(tmp_path), "--set", setting)
    assert done.returncode == (2 if said else 0)
    assert said in done.stderr


def test_a_table_of_a_spreadsheet(tmp_path: Path) -> None:
    """Quotes, semicolons, comments, blank rows and empty cells: the numbers of the plain table, and
    each with the line of the file in which it is."""
    plain = read_rows(data_file(tmp_path, f"{AT}5,9\n10,\n"), Files())
    text = '# Monday\n\n"applied [mT]";"tip_uz [mm]"\n;\n"5";"9" # first\n10;nan\n'
    quoted = read_rows(data_file(tmp_path, text), Files())
    assert quoted.units == plain.units == {"applied": "mT", "tip_uz": "mm"}
    for name, column in plain.columns.items():
        np.testing.assert_array_equal(quoted.columns[name], column)
    assert (list(plain.lines), list(quoted.lines)) == ([2, 3], [5, 6])
    above = read_rows(data_file(tmp_path, "# scan of Monday\n# x y [mm]\n1 2\n"), Files())
    assert above.units == {"x": None, "y": "mm"}


@pytest.mark.slow
def test_rows_without_a_number_are_counted(tmp_path: Path) -> None:
    """What is nan or empty is said in the output and in identify.json, by column; the band is that
    of the table without these rows.
    """
    text = (
        CAP.replace("{kind: pressure, until: limit}", "{kind: field, points: 1}")
        + "symmetry: axisymmetric\n"
    )
    case = case_file(tmp_path, text + "identify: {parameters: {shell.youngs_modulus: {}}}\n")
    found = dict[str, dict[str, Any]]()
    for name, rows in {
        "some": "3,-4.5\n4,nan\n6,-9\n7,\n10,-15\n",
        "all": "3,-4.5\n6,-9\n10,-15\n",
    }.items():
        found[name] = ms.identify(
            case, data_file(tmp_path, "applied [mT],w_pole [um]\n" + rows), out=tmp_path / name
        ).content
    assert found["some"]["missing"] == {"w_pole": 2}
    assert "w_pole: rows without a number, left out: 2" in found["some"]["said"]
    assert found["all"]["missing"] == {}
    assert found["some"]["parameters"] == found["all"]["parameters"]


@pytest.mark.slow
def test_one_datum_says_no_noise(tmp_path: Path) -> None:
    """With a wide prior the fit would follow it, and the band were a point."""
    data = data_file(tmp_path, "applied [mT],tip_uz [mm]\n10,10.6\n")
    wide = "identify.parameters={shell.youngs_modulus: {prior: 1000 kPa, deviation: 1e6 kPa}}"
    case = case_file(tmp_path, COARSE + "identify: {}\n")
    done = magshell("identify", case, "--data", data, "--out", tmp_path / "out", "--set", wide)
    assert done.returncode == 2
    assert (
        "identify.noise: tip_uz: 1 data do not say the noise beside 1 parameters: give it"
        in done.stderr
    )
