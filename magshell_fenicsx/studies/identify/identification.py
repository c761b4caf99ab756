"""Parameters of a case from measured data: the fit, its posterior, and what to measure next.

Every evaluation is kept: an identification that is started again takes those in its folder and goes
on.

A parameter is a number of the case; p parameters are a vector x, in which the numbers of a
remanence field follow the keys. A prior is what is known of a parameter before: mean and standard
deviation. A reading is a result of the case at a place, a value of what its last step prescribes.
Settings `key=value` say for which case a reading is. A candidate is a reading that may be measured
next. A programme is another history that is predicted with the fit. The noise of a column of data
is the standard deviation of its errors. |B^r| is the size of the remanence.
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
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.simulate.readings import Reading
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.studies.identify.data import (
    OF_POINTS,
    MeasuredTable,
    candidate,
    table_of,
    with_shape,
)
from magshell_fenicsx.studies.identify.laplace import (
    NORMAL,
    Measured,
    NoNoise,
    NotSeen,
    Posterior,
    fit_posterior,
    nonlinearity,
)
from magshell_fenicsx.studies.identify.parameters import Parameter, parameters_of
from magshell_fenicsx.studies.identify.picture import draw_identified
from magshell_fenicsx.studies.identify.predictor import Predictor, source_with_numbers
from magshell_fenicsx.studies.identify.programme_input import programme
from magshell_fenicsx.studies.identify.programmes import Programme
from magshell_fenicsx.studies.identify.remanence_field import (
    NAME,
    RemanenceField,
    field_of,
    flux_density,
)
from magshell_fenicsx.studies.identify.result_names import ResultNames
from magshell_fenicsx.studies.identify.sections import IdentifySection
from magshell_fenicsx.studies.identify.sentences import sentences
from magshell_fenicsx.studies.points import MakeCase, identity, short_key
from magshell_fenicsx.studies.runner import Say
from magshell_fenicsx.studies.store import Folder, write_table

Array = NDArray[np.float64]
FOLDER = Folder(
    "an identification",
    ("identify.json", "identify.csv", "identify.png", "remanence.csv"),
    ("case", "parameters", "predicted"),
)
INFLUENCE_TOLERANCE = (
    1e-9  # change of a result over that of a parameter, both relative: it has no influence
)


@dataclass(frozen=True)
class Identified:
    """A finished identification.

    Attributes
    ----------
    content
        The content of identify.json.
    fit
        The posterior of the parameters, in the units of the case.
    """

    content: dict[str, Any]
    fit: Posterior

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Key -> value, deviation, low and high of its 95 % band, unit, and its prior."""
        return dict(self.content["parameters"])

    @property
    def remanence(self) -> dict[str, Any] | None:
        """The identified remanence field, as in identify.json; None if no field was identified.

        Places are over R, values over |B^r|; it has their deviations, bands and prior.
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
    make_case: MakeCase,
) -> Identified:
    """Find the numbers of a case that fit measured data, and how sure they are; collective.

    Parameters
    ----------
    data
        A CSV file: each column is a result of the case, what its last step prescribes, or a key;
        see `IdentifySection`.
    out
        Folder of identify.json, identify.csv (data, predictions and bands), identify.png and
        points/; of a field also remanence.csv, its vectors.
    make_case
        Makes a case of its source, the same on all ranks.

    Raises
    ------
    CaseError
        If the case has no section `identify`, or data are no results of it or outside its path; if
        a parameter has no influence, or data and priors do not determine all parameters.
    Stopped
        If the path of the case is lost.
    """
    source = on_first_rank(comm, lambda: read_source(Path(file), settings))
    case, folder, name = make_case(source), user_folder(out), Path(file).name
    section: IdentifySection | None = case.identify
    if section is None:
        raise CaseError(f"{file}: identify: is missing: it says which parameters are looked for")
    try:
        parameters = parameters_of(source, case, section)
        field, extended_source = field_of(source, case, section.remanence, len(parameters))
        extended_source, rows, shape = on_first_rank(
            comm, lambda: with_shape(Path(data), extended_source)
        )
        case = make_case(extended_source)
        table = on_first_rank(comm, lambda: table_of(Path(data), case, section, rows, shape))
        names = ResultNames(case)
        candidates = [
            candidate(names, item, f"identify.candidates.{i}")
            for i, item in enumerate(section.candidates)
        ]
        _refuse_few(table, parameters)
        _refuse_priors(extended_source, parameters, make_case)
        programmes = _programmes(section, extended_source, parameters, make_case, field)
        with FOLDER.locked(folder, comm, name):
            say_on_first_rank: Say = say if comm.rank == 0 else lambda line: None
            # predictions do not change the fit, whose stored evaluations stay valid
            mark = identity(make_case(_without_predictions(extended_source))) + repr(
                [item.key for item in parameters]
            )
            predictor = Predictor(
                source=extended_source,
                make_case=make_case,
                parameters=parameters,
                readings=dict(table.readings),
                folder=folder,
                mark=mark,
                comm=comm,
                field=field,
                rows=table.rows,
            )
            identified, draw_result = _fit_and_predict(
                predictor, section, table, candidates, say_on_first_rank, flux_density(case)
            )
            identified.content.update(case=name, data=Path(data).name, settings=list(settings))
            for item in programmes:
                item.compute(predictor, identified.fit, say)
            access_disk(
                comm, lambda: _write(identified, draw_result, folder, predictor, programmes)
            )
    except CaseError as e:
        raise CaseError(case.with_place(str(e))) from None
    for line in identified.content["said"]:
        say_on_first_rank(line)
    return identified


def _programmes(
    section: IdentifySection,
    source: Source,
    parameters: Sequence[Parameter],
    make_case: MakeCase,
    field: RemanenceField | None,
) -> list[Programme]:
    """Return the programmes of `identify.predict`, whose results are predicted; collective.

    Parameters
    ----------
    source
        The identified case.
    field
        The remanence field that is identified; None if there is none.

    Raises
    ------
    CaseError
        As `programme`.
    """
    return [
        programme(name, source, parameters, item, make_case, with_field=field is not None)
        for name, item in section.predict.items()
    ]


def _without_predictions(source: Source) -> Source:
    """Return the case without `identify.predict`, on which the fit does not depend."""
    section = {key: value for key, value in source.data["identify"].items() if key != "predict"}
    return replace(source, data={**source.data, "identify": section})


def _refuse_few(table: MeasuredTable, parameters: Sequence[Parameter]) -> None:
    """Check that there are enough data for the parameters.

    Raises
    ------
    CaseError
        If data are fewer than parameters without a prior, or too few to estimate their noise; or if
        a parameter is a key in the data.
    """
    # parameters without a prior must be determined by the data alone
    keys_without_prior = [p.key for p in parameters if np.isinf(p.deviation)]
    needed_count = len(keys_without_prior)
    if len(table.data) < needed_count:
        raise CaseError(
            f"identify.parameters: {len(table.data)} data do not determine {needed_count} "
            "parameters without a prior "
            f"({', '.join(keys_without_prior)}): give prior and deviation of "
            f"{needed_count - len(table.data)} of "
            "them, or more data"
        )
    # a key that a column of the data gives is known: it cannot be a parameter
    keys = {setting.partition("=")[0] for settings in table.readings for setting in settings}
    if parameter_in_data := next(
        (parameter.key for parameter in parameters if parameter.key in keys), None
    ):
        raise CaseError(
            f"identify.parameters.{parameter_in_data}: is a column of the data, so it is known"
        )
    for number, column in enumerate(table.columns):
        count = int((table.column == number).sum())
        # residuals must be more than parameters for a noise to be estimated
        if np.isnan(column.noise) and count <= needed_count:
            raise _noise_error(table, number, parameter_count=needed_count)


def _refuse_priors(source: Source, parameters: Sequence[Parameter], make_case: MakeCase) -> None:
    """Check that the mean of each prior makes a valid case, within the bounds of its keys.

    Raises
    ------
    CaseError
        With the key of the prior, and what the case says.
    """
    for parameter in parameters:
        if np.isinf(parameter.deviation):
            continue
        try:
            make_case(source_with_numbers(source, [parameter.number], np.array([parameter.mean])))
        except CaseError as e:
            raise CaseError(f"identify.parameters.{parameter.key}.prior: {e}") from None


def _noise_error(table: MeasuredTable, column: int, parameter_count: int) -> CaseError:
    """Return the error that the noise of a column cannot be estimated.

    Parameters
    ----------
    column
        Index of the column in the table.
    parameter_count
        Number of parameters that these data determine.
    """
    header, count = table.columns[column].header, int((table.column == column).sum())
    return CaseError(
        f"identify.noise: {header}: {count} data do not say the noise beside {parameter_count} "
        "parameters: give it"
    )


def _fit_and_predict(
    predictor: Predictor,
    section: IdentifySection,
    table: MeasuredTable,
    candidates: Sequence[tuple[Reading, str, float]],
    say: Say,
    flux_scale: tuple[float, str],
) -> tuple[Identified, Callable[[Path], None]]:
    """Fit the parameters, and predict data and candidates with their bands; collective.

    Parameters
    ----------
    predictor
        Predicts the readings of the data for a vector of parameters.
    candidates
        For each candidate its reading, its unit, and the standard deviation of such a measurement.
    flux_scale
        |B^r| and its unit, in which a remanence field is reported.

    Returns
    -------
    identified
        The posterior and the content of identify.json.
    draw_result
        Draws the picture into a file.

    Raises
    ------
    CaseError
        If the data do not determine parameters or noise, or the case is not valid.
    Stopped
        If the path of the case is lost at the start.
    """
    parameters, field = predictor.parameters, predictor.field
    measured, start, size = _data_and_scales(predictor, table)
    first = predictor(start)
    if first.note:  # nothing is predicted
        raise (CaseError if first.invalid else Stopped)(
            f"the case itself does not predict the data: {first.note}"
        )
    _refuse_idle(np.array(first.slopes), np.array(first.values), size, parameters)

    def model(x: Array, *, slopes: bool = True) -> tuple[Array, Array] | None:
        """Return values (n,) and slopes (n, p) at parameters (p,); None without a prediction."""
        prediction = predictor(x, slopes=slopes)
        if prediction.note:
            say(f"       {_parameters_text(parameters, x)}: {prediction.note}")
            return None
        return np.array(prediction.values), np.array(prediction.slopes)

    def report_step(step: int, x: Array, misfit: float, noise: Array) -> None:
        """Say a step of the fit, with parameters (p,), and how near to the data it is.

        That is the misfit over the number of data. But an estimated noise makes it a constant: then
        the noise itself falls.
        """
        words = [
            f"noise of {column.header} {deviation:.4g}"
            for column, deviation in zip(table.columns, noise, strict=True)
            if np.isnan(column.noise)
        ]
        if len(words) < len(table.columns):
            words.insert(0, f"misfit {misfit:.4g} of the noise squared")
        say(f"{step:5d}  {', '.join(words)}, {_parameters_text(parameters, x)}")

    try:
        posterior = fit_posterior(model, measured, start, size, section.steps, report_step)
    except NotSeen as e:
        indistinguishable = [parameters[number].key for number in e.numbers]
        raise CaseError(
            f"identify.parameters: {' and '.join(indistinguishable)} cannot be told apart by these "
            "data: give one of them a prior"
        ) from None
    except NoNoise as e:
        raise _noise_error(table, e.column, parameter_count=len(parameters)) from None
    # is the posterior normal? this takes values alone
    misfit_difference, lost_count = nonlinearity(partial(model, slopes=False), posterior)
    content = _content(predictor, table, posterior)
    content["remanence"] = field.summary(posterior, flux_scale) if field else None
    content["normal"] = {"difference": misfit_difference, "lost": lost_count, "within": NORMAL}
    content["predicted"], content["next"] = _predict_candidates(
        predictor, section, posterior, candidates
    )
    content["evaluations"] = predictor.count
    content["programmes"] = {}
    content["said"] = sentences(content, posterior, table)
    draw_result = partial(draw_identified, content, _curves(predictor, table, posterior))
    return Identified(content, posterior), draw_result


def _data_and_scales(predictor: Predictor, table: MeasuredTable) -> tuple[Measured, Array, Array]:
    """Return the data with the priors, and the start and the scale of each parameter.

    Returns
    -------
    measured
        Data, noise and priors; nan for noise that is to be estimated.
    start
        (p,) parameters of the case itself, then the numbers of a field.
    size
        (p,) scales, for well-conditioned steps: the deviation of the prior, without one the size of
        the start.
    """
    parameters, field = predictor.parameters, predictor.field
    field_start = field.start_values if field else np.zeros(0)
    start = np.array([*(parameter.start for parameter in parameters), *field_start])
    mean = np.array([*(parameter.mean for parameter in parameters), *field_start])
    deviation = np.array(
        [*(parameter.deviation for parameter in parameters), *np.full(field_start.size, np.inf)]
    )
    noise = np.array([column.noise for column in table.columns])
    measured = Measured(
        table.data, table.column, noise, mean, deviation, field.smooth if field else None
    )
    finite = np.where(np.isfinite(deviation), deviation, np.abs(start))
    size = np.where(finite > 0, finite, 1.0)
    size[len(parameters) :] = 1.0  # numbers of a field are over |B^r|
    return measured, start, size


def _parameters_text(parameters: Sequence[Parameter], x: Array) -> str:
    """Return a vector of parameters as text; of a field its root mean square."""
    # the keys come first, and may be followed by the numbers of a field
    texts = [
        f"{short_key(p.key)} = {v:.6g} {p.unit}".rstrip()
        for p, v in zip(parameters, x, strict=False)
    ]
    if len(x) > len(parameters):
        texts.append(f"{NAME} of {np.sqrt(np.mean(x[len(parameters) :] ** 2)):.6g}")
    return ", ".join(texts)


def _refuse_idle(
    slopes: Array, values: Array, size: Array, parameters: Sequence[Parameter]
) -> None:
    """Check that every parameter, and the field if any, has an influence on the data.

    Parameters
    ----------
    slopes, values
        (n, p) and (n,), derivatives and predictions at the start.
    size
        (p,) scale of each parameter.

    Raises
    ------
    CaseError
        With the names of parameters without influence.
    """
    # (p,) largest change of a result by each parameter, relative to the largest result
    strongest = np.abs(slopes * size).max(axis=0) / (np.abs(values).max() or 1.0)
    # name of a parameter, and its change; the numbers of a field follow the parameters
    changes = [*zip([p.key for p in parameters], strongest, strict=False)]
    field_changes = strongest[len(parameters) :]
    if field_changes.size:
        changes.append((NAME, field_changes.max(initial=np.inf)))
    if idle := [key for key, change in changes if change < INFLUENCE_TOLERANCE]:
        raise CaseError(
            f"identify.parameters: {', '.join(idle)}: has no influence on these data where the "
            "case starts"
        )


def _content(predictor: Predictor, table: MeasuredTable, posterior: Posterior) -> dict[str, Any]:
    """Return the identified parameters, noise and predictions, as in identify.json."""
    measured, noise_of_data = posterior.measured, posterior.noise[table.column]
    # header of a column -> its noise; the freedom of given noise is infinite, which JSON has not
    noise = {
        column.header: {
            "deviation": float(posterior.noise[i]),
            "unit": column.unit,
            "estimated": bool(np.isnan(measured.noise[i])),
            "degrees_of_freedom": None
            if np.isinf(posterior.freedom[i])
            else float(posterior.freedom[i]),
        }
        for i, column in enumerate(table.columns)
    }
    return {
        "parameters": _content_of_parameters(predictor.parameters, posterior),
        "correlation": posterior.correlation.tolist(),
        "covariance": posterior.covariance.tolist(),
        "noise": noise,
        "places": table.places,
        "shape": dict(table.shape),
        "missing": dict(table.missing),
        "misfit_over_noise": float(
            np.sqrt(np.mean(((measured.data - posterior.y) / noise_of_data) ** 2))
        ),
        "steps": posterior.steps,
        "ended": posterior.ended,
        "rows": _rows_of_data(table, posterior),
        "sources": code_version(),
    }


def _content_of_parameters(
    parameters: Sequence[Parameter], posterior: Posterior
) -> dict[str, dict[str, Any]]:
    """Return key of a parameter -> its value, deviation, 95 % band and prior, for identify.json."""
    low, high = posterior.band
    quantiles = posterior.quantiles(np.eye(len(posterior.x)))
    return {
        p.key: {
            "value": float(posterior.x[i]),
            "deviation": float(posterior.deviation[i]),
            "low": float(low[i]),
            "high": float(high[i]),
            "quantile": float(quantiles[i]),
            "unit": p.unit,
            "start": p.start,
            "prior": None if np.isinf(p.deviation) else {"mean": p.mean, "deviation": p.deviation},
        }
        for i, p in enumerate(parameters)
    }


def _rows_of_data(table: MeasuredTable, posterior: Posterior) -> list[dict[str, Any]]:
    """Return the rows of identify.csv: for each datum its prediction at the fit, with bands."""
    spread, noise_of_data = posterior.spread(posterior.slopes), posterior.noise[table.column]
    # half widths of the 95 % bands: of predictions, and of measurements with noise
    half_width = posterior.quantiles(posterior.slopes) * spread
    half_measured = posterior.quantiles(posterior.slopes, table.column) * np.hypot(
        spread, noise_of_data
    )
    settings_and_readings = [
        (settings, reading) for settings, readings in table.readings.items() for reading in readings
    ]
    return [
        {
            "result": reading.of,
            "column": table.columns[table.column[i]].header,
            "settings": "; ".join(settings),
            "at": "end" if reading.at is None else reading.at,
            "measured": float(table.data[i]),
            "predicted": float(posterior.y[i]),
            "low": float(posterior.y[i] - half_width[i]),
            "high": float(posterior.y[i] + half_width[i]),
            "noise": float(noise_of_data[i]),
            "low_measured": float(posterior.y[i] - half_measured[i]),
            "high_measured": float(posterior.y[i] + half_measured[i]),
        }
        for i, (settings, reading) in enumerate(settings_and_readings)
    ]


def _predict_candidates(
    predictor: Predictor,
    section: IdentifySection,
    posterior: Posterior,
    candidates: Sequence[tuple[Reading, str, float]],
) -> tuple[list[dict[str, Any]], dict[str, Any] | None]:
    """Predict the candidates, and choose the next measurement; collective.

    Parameters
    ----------
    section
        Its `narrow` may name the parameter whose deviation the next measurement is to narrow.
    candidates
        For each candidate its reading, its unit, and the standard deviation of such a measurement.

    Returns
    -------
    rows
        A row for each candidate: value, band and deviations after its measurement; or a note why
        there is no value.
    next
        The candidate that narrows a parameter most, and by how much; None without predicted ones.
    """
    if not candidates:
        return [], None
    keys = [parameter.key for parameter in predictor.parameters]
    # of each parameter; the field, if any, has one for all its numbers
    deviations = _deviations_by_key(keys, posterior.deviation)
    # by default narrow the parameter with the largest relative deviation
    size = np.where(posterior.x != 0, np.abs(posterior.x), 1.0)
    relative_deviations = {key: deviations[key] / size[i] for i, key in enumerate(keys)}
    narrowed_key = section.narrow or (
        max(relative_deviations, key=relative_deviations.__getitem__) if keys else NAME
    )
    rows = [
        _row_of_candidate(predictor, posterior, reading, unit, noise)
        for reading, unit, noise in candidates
    ]
    predicted_rows = [predicted for predicted in rows if "value" in predicted]
    if not predicted_rows:
        return rows, None
    # the candidate after whose measurement this parameter has the least deviation
    best = min(predicted_rows, key=lambda predicted: predicted["deviations_then"][narrowed_key])
    narrowing = {
        "parameter": narrowed_key,
        "from": deviations[narrowed_key],
        "to": best["deviations_then"][narrowed_key],
    }
    return rows, {"result": best["result"], "at": best["at"], "unit": best["unit"], **narrowing}


def _row_of_candidate(
    predictor: Predictor, posterior: Posterior, reading: Reading, unit: str, noise: float
) -> dict[str, Any]:
    """Predict a candidate with its band, or say in a note why it is not predicted; collective.

    Parameters
    ----------
    predictor
        Predictor of the data; it counts this prediction too.
    reading, unit, noise
        The candidate, its unit, and the standard deviation of such a measurement.
    """
    # predicts this reading alone, of the case itself: without settings
    candidate_predictor = Predictor(
        source=predictor.source,
        make_case=predictor.make_case,
        parameters=predictor.parameters,
        readings={(): [reading]},
        folder=predictor.folder,
        mark=predictor.mark,
        comm=predictor.comm,
        field=predictor.field,
    )
    prediction = candidate_predictor(posterior.x)
    predictor.count += candidate_predictor.count
    place = "end" if reading.at is None else reading.at
    row = {"result": reading.of, "at": place, "unit": unit}
    if prediction.note:
        return {**row, "note": prediction.note}
    # the only reading of this prediction, and the half width of its band
    value, slope = prediction.values[0], np.array(prediction.slopes[0])
    half_widths = posterior.quantiles(slope[None]) * posterior.spread(slope[None])
    half_width = float(half_widths[0])
    # the deviations of all parameters after this measurement
    keys = [parameter.key for parameter in predictor.parameters]
    narrowed = _deviations_by_key(keys, posterior.narrowed(slope, noise))
    return {
        **row,
        "value": value,
        "low": value - half_width,
        "high": value + half_width,
        "noise": noise,
        "deviations_then": narrowed,
    }


def _deviations_by_key(keys: Sequence[str], deviations: Array) -> dict[str, float]:
    """Return key -> standard deviation; of the numbers of a field their root mean square.

    Parameters
    ----------
    keys
        Keys of the parameters, which stand before the numbers of the field.
    deviations
        (p,) standard deviations; more than keys if there is a field.
    """
    field_deviations = deviations[len(keys) :]
    field_deviation = (
        {NAME: float(np.sqrt(np.mean(field_deviations**2)))} if field_deviations.size else {}
    )
    return {key: float(v) for key, v in zip(keys, deviations, strict=False)} | field_deviation


def _curves(
    predictor: Predictor, table: MeasuredTable, posterior: Posterior
) -> dict[str, list[tuple[float, float]]]:
    """Return result -> places and values along the path at the fit, up to the last datum.

    Collective.
    """
    prediction, curves = predictor(posterior.x), dict[str, list[tuple[float, float]]]()
    for result, curve in prediction.curves.items():
        if result.startswith(OF_POINTS):
            continue  # displacements of a measured shape have no curve
        places = [
            r.at
            for readings in table.readings.values()
            for r in readings
            if r.of == result and r.at is not None
        ]
        # the first point beyond all places of the data (not the start); the last point if none is
        end_index = next(
            (i for i in range(len(curve)) if i and abs(curve[i][0]) >= max(map(abs, places))),
            len(curve) - 1,
        )
        curves[result] = curve[: end_index + 1]
    return curves


def _write(
    identified: Identified,
    draw_result: Callable[[Path], None],
    folder: Path,
    predictor: Predictor,
    programmes: Sequence[Programme],
) -> None:
    """Write predictions of programmes, tables, pictures and identify.json; called on rank 0.

    Parameters
    ----------
    identified
        Gets the content and the sentences of the programmes.
    draw_result
        Draws the picture into a file.
    """
    for programme_of_case in programmes:
        prediction = programme_of_case.prediction(folder, identified.content["noise"])
        identified.content["programmes"][programme_of_case.name] = prediction.content
        identified.content["said"] += prediction.said  # sentences that are printed at the end
        prediction.write(folder)
    write_object(folder / "identify.json", identified.content)
    write_table(identified.content["rows"], folder / "identify.csv")
    draw_result(folder / "identify.png")
    if predictor.field:
        predictor.field.write(
            identified.fit.x[len(predictor.parameters) :], folder / "remanence.csv"
        )
