"""Annotations that say whether a text in a config names a file; `framework.configuration.paths` reads them."""

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True)
class Mark:
    """Annotation that says whether a text is a path."""

    path: bool


FilePath = Annotated[str, Mark(path=True)]
"""Annotation of a parameter that names a file or folder."""
Words = Annotated[str, Mark(path=False)]
"""Annotation of a parameter whose text is never used as a path, such as the unit "km/h" of a column."""
