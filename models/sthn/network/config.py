"""What a network is built from: the numbers of a released checkpoint's `config.json`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any


class ConfigError(ValueError):
    """A configuration that does not state, or misstates, a number. The text names the field."""


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """The seven numbers of `config.json` (`model_config`), under their released names. None has a default: the
    correlation levels of a checkpoint cannot be guessed (2 for W_S = 512, 4 for 1024 and 1536)."""

    resize_width: int
    """W_R: side of both network inputs, pixels."""
    database_size: int
    """W_S: side of the satellite window, pixels at 1 m/px."""
    corr_level: int
    """Levels of the coarse correlation pyramid. The fine network always has 2."""
    iters_lev0: int
    """K_1: iterations of the coarse stage."""
    iters_lev1: int
    """K_2: iterations of the fine stage."""
    fine_padding: int
    """Padding on each side of the coarse box, window pixels: 32 in the paper's evaluation, 0 in a released config."""
    two_stages: bool
    """Whether there is a fine network."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            wanted = bool if field.name == "two_stages" else int
            if type(value) is not wanted:
                raise ConfigError(f"model_config.{field.name}: expected {wanted.__name__}, found {value!r}")
        width = self.resize_width
        if width < 32 or width & (width - 1):
            raise ConfigError(f"model_config.resize_width: expected a power of two of at least 32, found {width}")
        if self.database_size < 2:
            raise ConfigError(f"model_config.database_size: expected at least 2, found {self.database_size}")
        most = (width // 4).bit_length() - 1
        if not 1 <= self.corr_level <= most:
            raise ConfigError(f"model_config.corr_level: expected 1 to {most}, found {self.corr_level}")
        for name in ("iters_lev0", "iters_lev1"):
            if not 1 <= getattr(self, name) <= 64:
                raise ConfigError(f"model_config.{name}: expected 1 to 64, found {getattr(self, name)}")
        if self.fine_padding < 0:
            raise ConfigError(f"model_config.fine_padding: expected at least 0, found {self.fine_padding}")

    @property
    def alpha(self) -> float:
        """alpha = W_S / W_R: window pixels per network pixel."""
        return self.database_size / self.resize_width

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> NetworkConfig:
        """From the inner table of `config.json`. A missing or unknown field is an error that names it."""
        known = [field.name for field in dataclasses.fields(cls)]
        if missing := [name for name in known if name not in fields]:
            raise ConfigError(f"model_config: missing {', '.join(missing)}")
        if unknown := [name for name in fields if name not in known]:
            raise ConfigError(f"model_config: unknown {', '.join(unknown)}")
        return cls(**fields)

    @classmethod
    def read(cls, path: Path) -> NetworkConfig:
        """From a released `config.json`: `{"model_config": {...}}`."""
        try:
            document = json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: {error}") from error
        inner = document.get("model_config") if isinstance(document, dict) else None
        if not isinstance(inner, dict):
            raise ConfigError(f"{path}: model_config: expected a table, found {type(inner).__name__}")
        return cls.from_dict(inner)

    def to_json(self) -> str:
        """The text of a released `config.json`."""
        return json.dumps({"model_config": dataclasses.asdict(self)}, indent=1)
