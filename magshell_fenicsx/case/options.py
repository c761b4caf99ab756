"""Keys of the section `output` as options of a command."""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.input.messages import explained
from magshell_fenicsx.input.source import CaseError, Source


class _Options(BaseModel):
    output: OutputSection


def output_section(case: Mapping[str, Any], options: Mapping[str, Any]) -> OutputSection:
    """The section `output` of a case with options in place of its keys.

    Raises
    ------
    CaseError
        If an option is wrong: the option, the value, what is allowed.
    """
    source = Source("options", {"output": {**case, **options}})
    for key in options:
        source.places["output", key] = f"--{key.replace('_', '-')}"
    try:
        return _Options.model_validate(source.data).output
    except ValidationError as e:
        raise CaseError(explained(e.errors(), source, _Options)) from None


def plot_options(
    formats: str | None,
    width: float | None,
    dpi: int | None,
    font_size: float | None,
    camera: str | None,
    ranges: Sequence[str],
) -> dict[str, Any]:
    """The options that are given, as keys of the section.

    Raises
    ------
    CaseError
        If a camera or a range cannot be read.
    """
    given: dict[str, Any] = {"width": width, "dpi": dpi, "font_size": font_size}
    given["formats"] = formats.split(",") if formats else None
    if camera:
        angles = _numbers(camera, ",", f"--camera {camera}: write it as POLAR,AZIMUTH in degrees, for example 55,-60")
        given["camera"] = dict(zip(("polar", "azimuth"), angles, strict=True))
    if ranges:
        given["ranges"] = {}
    for text in ranges:
        name, _, limits = text.partition("=")
        said = f"--range {text}: write it as FIELD=LOW:HIGH, for example w_over_h=-2:2"
        given["ranges"][name] = list(_numbers(limits, ":", said))
    return {key: value for key, value in given.items() if value is not None}


def _numbers(text: str, between: str, said: str) -> tuple[float, float]:
    try:
        first, second = map(float, text.split(between))
    except ValueError:
        raise CaseError(said) from None
    return first, second
