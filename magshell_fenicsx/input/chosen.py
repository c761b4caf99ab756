"""One of several sections, chosen by a key. Only the validators of chosen ones are built: a case has few of many."""

from dataclasses import dataclass
from typing import Annotated, Any, get_args

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, core_schema


@dataclass(frozen=True)
class Chosen:
    """In an annotation: which key chooses; each section has the values that choose it as the key's `Literal`."""

    by: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        choices = {
            tag: handler.generate_schema(Annotated[section, _Later(section)])
            for section in get_args(source)
            for tag in get_args(section.model_fields[self.by].annotation)
        }
        return core_schema.tagged_union_schema(choices, self.by)


@dataclass(frozen=True)
class _Later:
    """A section whose validator is built when it is needed."""

    section: type[BaseModel]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(self._validated)

    def _validated(self, value: Any, info: ValidationInfo) -> BaseModel:
        return self.section.model_validate(value, context=info.context)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        self.section.model_rebuild()
        return handler(self.section.__pydantic_core_schema__)
