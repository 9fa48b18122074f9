import pytest


@pytest.fixture(autouse=True)
def toc_cache(monkeypatch, tmp_path_factory):
    """cflib's cache, kept from one test to the next and away from the user's."""
    monkeypatch.setenv("ZENPARK_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "cache"))
