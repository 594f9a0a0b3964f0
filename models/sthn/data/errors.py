"""What can be wrong with data: one typed error that names file, key, expected and found."""

from __future__ import annotations

from pathlib import Path


class DataError(ValueError):
    """A file, or a table of a configuration, that is not what a source needs."""

    def __init__(self, file: str | Path, key: str, expected: str, found: object) -> None:
        self.file, self.key, self.expected, self.found = str(file), key, expected, str(found)
        super().__init__(f"{file}: {key}: expected {expected}, found {found}")

    def __reduce__(self) -> tuple:
        """A worker process hands its errors over by pickle."""
        return DataError, (self.file, self.key, self.expected, self.found)
