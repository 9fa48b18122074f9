"""The documentation site: builds without a warning, has every page, and its reference has every key."""

import re
from html import unescape
from pathlib import Path

import pytest

from agents.body.interface import BodyRequest, BodyState
from agents.formation.link import Link
from agents.plugins.triggers import TriggerView
from experiments.file import reference
from experiments.metrics.results import RobotMetrics
from experiments.recording.topics import TOPICS
from tests.commands import ROOT, environment, python
from tests.system.browser import CHROMIUM, needs_chromium
from tools.main import app


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    quiet = environment(NO_MKDOCS_2_WARNING="1")
    python("-m", "mkdocs", "build", "--site-dir", folder, env=quiet, timeout_s=500.0)
    return folder


def text(page: Path) -> str:
    return unescape(re.sub(r"<[^>]+>", "", page.read_text("utf-8")))


@pytest.mark.slow
def test_the_site_has_every_page_and_fetches_nothing(site):
    docs = ROOT / "docs"
    pages = [page.relative_to(docs).with_suffix("") for page in [*docs.glob("*.md"), *docs.glob("[gr]*/*.md")]]
    navigation = (site / "index.html").read_text("utf-8")
    assert not [page for page in pages if not (site / f"{page}.html").exists()]
    assert not [page for page in pages if f'href="{page}.html"' not in navigation and page.name != "index"]
    loads = re.compile(r"<(?:script|img|link)[^>]* (?:src|href)=\"?https?://[^\"> ]+")
    assert not [page for page in site.rglob("*.html") if loads.search(page.read_text("utf-8"))]


@pytest.mark.slow
@needs_chromium
def test_search_and_formulas_work_from_disk(site):
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto((site / "triggers.html").as_uri())
        page.locator("input.md-search__input").press_sequentially("self-triggered")
        page.locator(".md-search-result__item a[href*='triggers.html']").first.wait_for(timeout=60_000)
        assert page.locator("td math").count() > 0
        assert page.get_by_text("\\(").count() == 0
        browser.close()
    assert [url for url in asked if not url.startswith("file:")] == []


@pytest.mark.slow
def test_reference_has_every_key_command_topic_and_column(site):
    file = (site / "reference" / "experiment-file.html").read_text("utf-8")
    assert not [entry.key for entry in reference.entries() if entry.words[-1] not in file]
    commands = text(site / "reference" / "commands.html")
    named = [each.name for each in app.registered_groups if each.name]
    assert {"run", "check", "explain", *named} <= set(commands.split())
    assert all(topic.name in text(site / "reference" / "recordings.html") for topic in TOPICS)
    assert all(field in text(site / "reference" / "metrics.html") for field in RobotMetrics.__struct_fields__)
    assert "float | None" in text(site / "reference" / "metrics.html")
    pages = {page.stem: text(page) for page in (site / "reference").glob("*.html")}
    assert not [name for name, words in pages.items() if "&lt;" in words or "None \\|" in words or "\\| None" in words]
    assert "park/CF01/pose" in text(site / "reference" / "network.html")
    api = text(site / "reference" / "api.html")
    fields = {name for made in (BodyRequest, BodyState, Link, TriggerView) for name in made.__annotations__}
    assert not {"simulate", *fields} - set(api.split())
