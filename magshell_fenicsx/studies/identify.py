"""Parameters of a case from measured data: the fit, its posterior, and what to measure next.

Every evaluation is kept: an identification that is started again takes those in its folder and goes
on.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError, Source, read_source
from magshell_fenicsx.output.store.durable import write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.output.store.table import write_csv
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.simulate.readings import Reading
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.studies.identify_data import (
    OF_POINTS,
    Names,
    Parameter,
    Table,
    candidate,
    parameters_of,
    table_of,
    with_shape,
)
from magshell_fenicsx.studies.identify_field import NAME, field_of, flux_density
from magshell_fenicsx.studies.identify_picture import draw_identified
from magshell_fenicsx.studies.identify_predicted import Predictor, varied
from magshell_fenicsx.studies.identify_programmes import Programme, programme
from magshell_fenicsx.studies.identify_sections import IdentifySection
from magshell_fenicsx.studies.identify_words import sentences
from magshell_fenicsx.studies.laplace import (
    NORMAL,
    Fit,
    Measured,
    NoNoise,
    NotSeen,
    fitted,
    nonlinearity,
)
from magshell_fenicsx.studies.points import identity, short
from magshell_fenicsx.studies.runner import Folder, Made, Say

Array = NDArray[np.float64]
FOLDER = Folder(
    "an identification",
    ("identify.json", "identify.csv", "identify.png", "remanence.csv"),
    ("case", "parameters", "predicted"),
)
NOTHING = 1e-9  # change of a result over that of a parameter, both relative: it has no influence


@dataclass(frozen=True)
class Identified:
    """A finished identification.

    Attributes
    ----------
    content
        As in identify.json.
    fit
        The parameters, in the units of the case.
    """

    content: dict[str, Any]
    fit: Fit

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Key -> value, deviation, low and high of its 95 % band, unit, and its prior."""
        return dict(self.content["parameters"])

    @property
    def remanence(self) -> dict[str, Any] | None:
        """Of the field that was looked for: places over R, values over |B^r|, deviations and bands,
        and its prior.
        """
        field: dict[str, Any] | None = self.content["remanence"]
        return field


def identify(
    file: Path | str,
    data: Path | str,
    settings: Sequence[str] = (),
    out: Path | str = "results/identify",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = print_line,
    *,
    made: Made,
) -> Identified:
    """Find the numbers of a case that fit measured data, and how sure they are; collective.

    Parameters
    ----------
    data
        A CSV file; see `IdentifySection`.
    out
        Folder of identify.json, identify.csv (data, predictions and bands), identify.png and
        points/; of a field also remanence.csv, its vectors.
    made
        Makes a case of its source, the same on all ranks.

    Raises
    ------
    CaseError
        If the case looks for nothing, the data are none of its results or outside its path, a
        parameter has no influence, or data and priors do not determine all of them.
    Stopped
        If the path of the case is lost.
    """
    source = on_first_rank(comm, lambda: read_source(Path(file), settings))
    case, folder, name = made(source), user_folder(out), Path(file).name
    section: IdentifySection | None = case.identify
    if section is None:
        raise CaseError(f"{file}: identify: is missing: it says which parameters are looked for")
    try:
        parameters = parameters_of(source, case, section)
        field, wider = field_of(source, case, section.remanence, len(parameters))
        wider, rows, shape = on_first_rank(comm, lambda: with_shape(Path(data), wider))
        case = made(wider)
        table = on_first_rank(comm, lambda: table_of(Path(data), case, section, rows, shape))
        names = Names(case)
        others = [
            candidate(names, each, f"identify.candidates.{i}")
            for i, each in enumerate(section.candidates)
        ]
        _refuse_few(table, parameters)
        _refuse_priors(wider, parameters, made)
        programmes = [
            programme(name, wider, parameters, each, made, with_field=field is not None)
            for name, each in section.predict.items()
        ]
        with FOLDER.held(folder, comm, name):
            once: Say = say if comm.rank == 0 else lambda line: None
            mark = identity(made(_without_predictions(wider))) + repr(
                [each.key for each in parameters]
            )
            predictor = Predictor(
                wider, made, parameters, dict(table.readings), folder, mark, comm, field, table.rows
            )
            done, drawn = _identified(predictor, section, table, others, once, flux_density(case))
            done.content.update(case=name, data=Path(data).name, settings=list(settings))
            for each in programmes:
                each.compute(predictor, done.fit, say)
            access_disk(comm, lambda: _write(done, drawn, folder, predictor, programmes))
    except CaseError as e:
        raise CaseError(case.placed(str(e))) from None
    for line in done.content["said"]:
        once(line)
    return done


def _without_predictions(source: Source) -> Source:
    """The case as far as the fit depends on it: another prediction makes no evaluation new."""
    section = {key: value for key, value in source.data["identify"].items() if key != "predict"}
    return replace(source, data={**source.data, "identify": section})


def _refuse_few(table: Table, parameters: Sequence[Parameter]) -> None:
    """See that there are data enough.

    Raises
    ------
    CaseError
        If there are fewer than parameters without a prior, or too few to estimate their noise.
    """
    bare = [each.key for each in parameters if np.isinf(each.deviation)]
    if len(table.data) < len(bare):
        raise CaseError(
            f"identify.parameters: {len(table.data)} data do not determine {len(bare)} parameters without a prior "
            f"({', '.join(bare)}): give prior and deviation of {len(bare) - len(table.data)} of them, or more data"
        )
    keys = {setting.partition("=")[0] for settings in table.readings for setting in settings}
    if both := next((each.key for each in parameters if each.key in keys), None):
        raise CaseError(f"identify.parameters.{both}: is a column of the data, so it is known")
    for number, column in enumerate(table.columns):
        count = int((table.column == number).sum())
        if np.isnan(column.noise) and count <= len(bare):
            raise _no_noise(table, number, len(bare))


def _refuse_priors(source: Source, parameters: Sequence[Parameter], made: Made) -> None:
    """See that a case may have the mean of each prior: its keys have bounds, and so have
    parameters.

    Raises
    ------
    CaseError
        With the key of the prior, and what the case says.
    """
    for each in parameters:
        if np.isinf(each.deviation):
            continue
        try:
            made(varied(source, [each.number], np.array([each.mean])))
        except CaseError as e:
            raise CaseError(f"identify.parameters.{each.key}.prior: {e}") from None


def _no_noise(table: Table, column: int, parameters: int) -> CaseError:
    header, count = table.columns[column].header, int((table.column == column).sum())
    return CaseError(
        f"identify.noise: {header}: {count} data do not say the noise beside {parameters} parameters: give it"
    )


def _identified(
    predictor: Predictor,
    section: IdentifySection,
    table: Table,
    others: Sequence[tuple[Reading, str, float]],
    say: Say,
    over: tuple[float, str],
) -> tuple[Identified, Callable[[Path], None]]:
    parameters, field = predictor.parameters, predictor.field
    numbers = field.first if field else np.zeros(0)
    start = np.array([*(each.start for each in parameters), *numbers])
    mean = np.array([*(each.mean for each in parameters), *numbers])
    deviation = np.array([*(each.deviation for each in parameters), *np.full(numbers.size, np.inf)])
    noise = np.array([column.noise for column in table.columns])
    measured = Measured(
        table.data, table.column, noise, mean, deviation, field.smooth if field else None
    )
    finite = np.where(np.isfinite(deviation), deviation, np.abs(start))
    size = np.where(finite > 0, finite, 1.0)
    size[len(parameters) :] = 1.0
    first = predictor(start)
    if first.note:
        raise (CaseError if first.invalid else Stopped)(
            f"the case itself does not predict the data: {first.note}"
        )
    _refuse_idle(np.array(first.slopes), np.array(first.values), size, parameters)

    def model(x: Array, *, slopes: bool = True) -> tuple[Array, Array] | None:
        seen = predictor(x, slopes=slopes)
        if seen.note:
            say(f"       {_said(parameters, x)}: {seen.note}")
            return None
        return np.array(seen.values), np.array(seen.slopes)

    def told(step: int, x: Array, misfit: float) -> None:
        say(f"{step:5d}  misfit {misfit:.4g} of the noise squared, {_said(parameters, x)}")

    try:
        fit = fitted(model, measured, start, size, section.steps, told)
    except NotSeen as e:
        alike = [parameters[number].key for number in e.numbers]
        raise CaseError(
            f"identify.parameters: {' and '.join(alike)} cannot be told apart by these data: give one of them a prior"
        ) from None
    except NoNoise as e:
        raise _no_noise(table, e.column, len(parameters)) from None
    bent, lost = nonlinearity(partial(model, slopes=False), fit)
    content = _content(predictor, table, fit)
    content["remanence"] = field.found(fit, over) if field else None
    content["normal"] = {"difference": bent, "lost": lost, "within": NORMAL}
    content["predicted"], content["next"] = _others(predictor, section, fit, others)
    content["evaluations"] = predictor.count
    content["programmes"] = {}
    content["said"] = sentences(content, fit, table)
    drawn = partial(draw_identified, content, _curves(predictor, table, fit))
    return Identified(content, fit), drawn


def _said(parameters: Sequence[Parameter], x: Array) -> str:
    said = [
        f"{short(p.key)} = {v:.6g} {p.unit}".rstrip() for p, v in zip(parameters, x, strict=False)
    ]
    if len(x) > len(parameters):
        said.append(f"{NAME} of {np.sqrt(np.mean(x[len(parameters) :] ** 2)):.6g}")
    return ", ".join(said)


def _refuse_idle(
    slopes: Array, values: Array, size: Array, parameters: Sequence[Parameter]
) -> None:
    """See that every parameter changes something.

    Raises
    ------
    CaseError
        With the name of one that does not.
    """
    strongest = np.abs(slopes * size).max(axis=0) / (np.abs(values).max() or 1.0)
    of_field = strongest[len(parameters) :]
    changes = [
        *zip([p.key for p in parameters], strongest, strict=False),
        (NAME, of_field.max(initial=np.inf)),
    ]
    changes = changes if of_field.size else changes[:-1]
    if idle := [key for key, change in changes if change < NOTHING]:
        raise CaseError(
            f"identify.parameters: {', '.join(idle)}: has no influence on these data where the case starts"
        )


def _content(predictor: Predictor, table: Table, fit: Fit) -> dict[str, Any]:
    """What is found, as plain data."""
    measured = fit.known
    low, high = fit.band
    far = fit.quantiles(np.eye(len(fit.x)))
    parameters = {
        p.key: {
            "value": float(fit.x[i]),
            "deviation": float(fit.deviation[i]),
            "low": float(low[i]),
            "high": float(high[i]),
            "quantile": float(far[i]),
            "unit": p.unit,
            "start": p.start,
            "prior": None if np.isinf(p.deviation) else {"mean": p.mean, "deviation": p.deviation},
        }
        for i, p in enumerate(predictor.parameters)
    }
    spread, s = fit.spread(fit.slopes), fit.noise[table.column]
    half = fit.quantiles(fit.slopes) * spread
    half_measured = fit.quantiles(fit.slopes, table.column) * np.hypot(spread, s)
    listed = [(settings, each) for settings, of in table.readings.items() for each in of]
    rows = [
        {
            "result": each.of,
            "column": table.columns[table.column[i]].header,
            "settings": "; ".join(settings),
            "at": "end" if each.at is None else each.at,
            "measured": float(table.data[i]),
            "predicted": float(fit.y[i]),
            "low": float(fit.y[i] - half[i]),
            "high": float(fit.y[i] + half[i]),
            "noise": float(s[i]),
            "low_measured": float(fit.y[i] - half_measured[i]),
            "high_measured": float(fit.y[i] + half_measured[i]),
        }
        for i, (settings, each) in enumerate(listed)
    ]
    noise = {
        column.header: {
            "deviation": float(fit.noise[i]),
            "unit": column.unit,
            "estimated": bool(np.isnan(measured.noise[i])),
            "degrees_of_freedom": None if np.isinf(fit.freedom[i]) else float(fit.freedom[i]),
        }
        for i, column in enumerate(table.columns)
    }
    return {
        "parameters": parameters,
        "correlation": fit.correlation.tolist(),
        "covariance": fit.covariance.tolist(),
        "noise": noise,
        "places": table.places,
        "shape": dict(table.shape),
        "missing": dict(table.missing),
        "misfit_over_noise": float(np.sqrt(np.mean(((measured.data - fit.y) / s) ** 2))),
        "steps": fit.steps,
        "ended": fit.ended,
        "rows": rows,
        "sources": code_version(),
    }


def _others(
    predictor: Predictor,
    section: IdentifySection,
    fit: Fit,
    others: Sequence[tuple[Reading, str, float]],
) -> tuple[list[dict[str, Any]], dict[str, Any] | None]:
    """The candidates with their bands, and which of them narrows a parameter most."""
    if not others:
        return [], None
    keys = [each.key for each in predictor.parameters]
    deviations = _named(keys, fit.deviation)
    size = np.where(fit.x != 0, np.abs(fit.x), 1.0)
    relative = {key: deviations[key] / size[i] for i, key in enumerate(keys)}
    chosen = section.narrow or (max(relative, key=relative.__getitem__) if keys else NAME)
    rows = list[dict[str, Any]]()
    for reading, unit, noise in others:
        alone = Predictor(
            predictor.source,
            predictor.made,
            predictor.parameters,
            {(): [reading]},
            predictor.folder,
            predictor.mark,
            predictor.comm,
            predictor.field,
        )
        seen, row = (
            alone(fit.x),
            {"result": reading.of, "at": "end" if reading.at is None else reading.at, "unit": unit},
        )
        predictor.count += alone.count
        if seen.note:
            rows.append({**row, "note": seen.note})
            continue
        slope = np.array(seen.slopes[0])
        value, half = (
            seen.values[0],
            float((fit.quantiles(slope[None]) * fit.spread(slope[None]))[0]),
        )
        narrowed = _named(keys, fit.narrowed(slope, noise))
        low, high = value - half, value + half
        rows.append(
            {
                **row,
                "value": value,
                "low": low,
                "high": high,
                "noise": noise,
                "deviations_then": narrowed,
            }
        )
    there = [each for each in rows if "value" in each]
    if not there:
        return rows, None
    best = min(there, key=lambda each: each["deviations_then"][chosen])
    how = {"parameter": chosen, "from": deviations[chosen], "to": best["deviations_then"][chosen]}
    return rows, {"result": best["result"], "at": best["at"], "unit": best["unit"], **how}


def _named(keys: Sequence[str], deviations: Array) -> dict[str, float]:
    """Deviations by keys; of a field their root mean square."""
    of_field = deviations[len(keys) :]
    own = {NAME: float(np.sqrt(np.mean(of_field**2)))} if of_field.size else {}
    return {key: float(v) for key, v in zip(keys, deviations, strict=False)} | own


def _curves(predictor: Predictor, table: Table, fit: Fit) -> dict[str, list[tuple[float, float]]]:
    """Result -> the path at the fit, as far as data go."""
    seen, curves = predictor(fit.x), dict[str, list[tuple[float, float]]]()
    for of, curve in seen.curves.items():
        if of.startswith(OF_POINTS):
            continue
        places = [
            r.at
            for each in table.readings.values()
            for r in each
            if r.of == of and r.at is not None
        ]
        upto = next(
            (i for i in range(len(curve)) if i and abs(curve[i][0]) >= max(map(abs, places))),
            len(curve) - 1,
        )
        curves[of] = curve[: upto + 1]
    return curves


def _write(
    done: Identified,
    drawn: Callable[[Path], None],
    folder: Path,
    predictor: Predictor,
    programmes: Sequence[Programme],
) -> None:
    for each in programmes:
        predicted = each.found(folder, done.fit, done.content["noise"])
        done.content["programmes"][each.name] = predicted.content
        done.content["said"] += predicted.said
        predicted.write(folder)
    write_object(folder / "identify.json", done.content)
    rows = done.content["rows"]
    write_csv(rows, list(rows[0]), folder / "identify.csv")
    drawn(folder / "identify.png")
    if predictor.field:
        predictor.field.write(done.fit.x[len(predictor.parameters) :], folder / "remanence.csv")
