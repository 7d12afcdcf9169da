"""Annotations of texts in a config that name files, or never do; `framework.configuration.paths` reads them."""

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True)
class Mark:
    """What an annotation says of a text."""

    path: bool


FilePath = Annotated[str, Mark(path=True)]
"""Annotation of a parameter that names a file or folder."""
Words = Annotated[str, Mark(path=False)]
"""Annotation of a parameter whose text is never used as a path, as "km/h" of a column."""
