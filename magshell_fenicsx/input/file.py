"""Files that a section of a case reads."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import PrivateAttr, field_validator

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.platform.reading import Files


class FileKeys(Section):
    """Of sections that may read a file; its path is from the folder of the case."""

    file: str | None = None
    """From the folder of the case"""

    _folder: Path = PrivateAttr(default_factory=Path)
    _files: Files = PrivateAttr(default_factory=Files)

    def model_post_init(self, context: Any, /) -> None:
        given = context or {}
        self._folder = Path(given.get("folder", "")).absolute()
        self._files = given.get("files") or Files()

    @field_validator("file", check_fields=False)
    @classmethod
    def _a_name(cls, name: str | None) -> str | None:
        if name is not None and "\0" in name:
            raise ValueError(f"{name!r}: a file's name has no zero byte")
        if name == "":
            raise ValueError("the name is empty; give that of a file")
        return name

    @property
    def path(self) -> Path:
        """Where the file is."""
        return self._folder / (self.file or "")

    @property
    def files(self) -> Files:
        """The contents of the files of its case."""
        return self._files

    @property
    def digest(self) -> str | None:
        """Hash of the file's content; None if it cannot be read."""
        return self._files.digest(self.path)


def digests(sections: Mapping[str, object]) -> dict[str, str | None]:
    """Hashes of the files that sections read, by the keys of the files."""
    return {f"{key}.file": s.digest for key, s in sections.items() if isinstance(s, FileKeys) and s.file}
