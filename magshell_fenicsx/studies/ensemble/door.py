"""What is random in an ensemble, against the keys that a case can have: before any sample is drawn."""

import copy
import json
from collections.abc import Mapping

from pydantic import ValidationError

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.ensemble import EnsembleSection
from magshell_fenicsx.input.messages import explained
from magshell_fenicsx.input.source import CaseError, Source, override

# errors of pydantic about keys, which no value drawn can mend
OF_KEYS = ("extra_forbidden", "model_type", "model_attributes_type", "list_type", "dict_type")


def refuse_unknown_keys(source: Source, section: EnsembleSection) -> None:
    """Refuse random keys that the case cannot have, whatever their values.

    Raises
    ------
    CaseError
        One message with every such key.
    """
    drawn, refused = {key: json.dumps(each.at(0.5)) for key, each in section.keys.items()}, list[str]()
    here = copy.deepcopy(source)
    del here.data["ensemble"]
    for key, text in drawn.items():
        try:
            override(here, f"{key}={text}")
        except CaseError as e:
            refused.append(str(e))
    try:
        Case.model_validate(here.data, context={"folder": here.folder})
    except ValidationError as e:
        if errors := [error for error in e.errors() if error["type"] in OF_KEYS]:
            refused.append(explained(errors, here, Case))
    if refused:
        raise CaseError(in_the_file("\n".join(refused), source, drawn))


def in_the_file(message: str, source: Source, drawn: Mapping[str, str]) -> str:
    """A message about settings that were drawn, with the places of their distributions."""
    for key, text in drawn.items():
        place = f"{source.place(('ensemble', 'keys', key))}: ensemble.keys: "
        message = message.replace(f"--set {key}={text}: {key}: ", f"{place}{key}: ")
        message = message.replace(f"--set {key}={text}: ", f"{place}{key}: ")
    return message
