"""The list of all parts."""

from importlib import import_module
from inspect import cleandoc
from typing import TYPE_CHECKING

from pydantic import Field, create_model

from magshell_fenicsx.parts.own import WithOwnTerms
from magshell_fenicsx.parts.part import Part

REGISTERED: dict[str, str] = {
    # key of the case file, and name of the file here -> the class in it
    "foundation": "Foundation",
}
PARTS: dict[str, type[Part]] = {
    key: getattr(import_module(f"{__package__}.{key}"), name) for key, name in REGISTERED.items()
}


def _meaning(part: type[Part]) -> str:
    """The first sentence of its docstring."""
    return cleandoc(part.__doc__ or "").split(".")[0]


if TYPE_CHECKING:
    WithParts = WithOwnTerms
else:  # an optional key for each part
    WithParts = create_model(
        "WithParts",
        __base__=WithOwnTerms,
        **{key: (part | None, Field(default=None, description=_meaning(part))) for key, part in PARTS.items()},
    )
