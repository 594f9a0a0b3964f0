"""The pages that a reader starts from name only what exists."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest
from conftest import ROOT

from sthn.train import experiment

PAGES = [ROOT / "README.md", ROOT / "models" / "README.md", ROOT / "models" / "bundles" / "lite-1536" / "README.md"]


def source_of(module: str) -> str:
    """A module's text with that of its `__main__`."""
    found = importlib.util.find_spec(module)
    assert found is not None and found.origin is not None, module
    folder = Path(found.origin).parent
    paths = [Path(found.origin), folder / "__main__.py"] if found.submodule_search_locations else [Path(found.origin)]
    return "".join(path.read_text() for path in paths if path.is_file())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_every_command_and_option_exists(page: Path) -> None:
    text = page.read_text().replace("\\\n", " ")
    commands = re.findall(r"python -m (sthn[\w.]*)([^\n`]*)", text)
    assert commands
    for module, words in commands:
        code = source_of(module)
        if module == "sthn.convert":
            code += source_of("sthn.export")  # further words are the export's
        assert "__main__" in code or "def main" in code, module
        for option in re.findall(r"(?<=\s)--([a-z][\w-]*)", words):
            names = [f"--{option}", option] if module.endswith("figures") else [f"--{option}"]
            assert option == "help" or any(f'"{name}"' in code for name in names), f"{module}: --{option}"


def test_the_experiment_is_one() -> None:
    (block,) = re.findall(r"```toml\n(.*?)```", PAGES[1].read_text(), re.DOTALL)
    found = experiment.parse(tomllib.loads(block), "README.md")
    assert found.config.database_size == 1536 and found.source_table("train")["kind"] == "flight"


def test_every_path_of_the_package_exists() -> None:
    for page in PAGES:
        for path in re.findall(r"`((?:models|sthn)/[\w/.-]+)`", page.read_text()):
            at = ROOT / path if path.startswith("models/") else ROOT / "models" / path
            assert at.exists() or path.startswith("models/reports/"), f"{page}: {path}"
