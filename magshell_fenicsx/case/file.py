"""Files that a section of a case reads."""

import hashlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import PrivateAttr

from magshell_fenicsx.parts.section import Section


class FileKeys(Section):
    """Of sections that may read a file; its path is from the folder of the case."""

    file: str | None = None
    """From the folder of the case"""

    _folder: Path = PrivateAttr(default_factory=Path)

    def model_post_init(self, context: Any, /) -> None:
        self._folder = Path((context or {}).get("folder", "")).absolute()

    @property
    def path(self) -> Path:
        """Where the file is."""
        return self._folder / (self.file or "")

    @cached_property
    def digest(self) -> str | None:
        """Hash of the file's content; None if it cannot be read."""
        try:
            return hashlib.sha256(self.path.read_bytes()).hexdigest()
        except OSError:
            return None


def digests(sections: Mapping[str, object], remanent: object) -> dict[str, str | None]:
    """Hashes of the files that the remanence and other sections read, by the keys of the files."""
    sections = {"magnetic.remanent": remanent, **sections}
    return {f"{key}.file": s.digest for key, s in sections.items() if isinstance(s, FileKeys) and s.file}
