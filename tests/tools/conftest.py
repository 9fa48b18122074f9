import importlib.util
from importlib.machinery import SourceFileLoader
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def bootstrap(tmp_path):
    """The script as a module, in a checkout that has only the files that it reads."""
    for path in (ROOT / "zenpark", ROOT / "pyproject.toml", *ROOT.glob("requirements*.lock")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "python").touch(mode=0o755)
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    loader = SourceFileLoader("bootstrap", str(tmp_path / "zenpark"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("bootstrap", loader))
    loader.exec_module(module)
    return module
