"""The scripts that generate shipped data, as modules; they are not part of the package."""

import importlib.util
from pathlib import Path
from types import ModuleType

CONFIGS = Path(__file__).parents[1] / "configs"


def script(path: str) -> ModuleType:
    """The script at ``path``, relative to ``configs``, e.g. ``sites/works_yard/generate.py``."""
    name = "configs_" + path.removesuffix(".py").replace("/", "_")
    spec = importlib.util.spec_from_file_location(name, CONFIGS / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
