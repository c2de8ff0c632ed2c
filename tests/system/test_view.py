"""The page in a browser, with both processes running behind it on a recording of an upper body."""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warm

from bodyschema.cli.demo.scene import prepare
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import is_alive
from bodyschema.recordings.recording import Recording

pytest.importorskip("uvicorn")
pytest.importorskip("playwright")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
QUIET = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
QUIET += ["--disable-component-update", "--disable-sync"]
# Graphics in software take much CPU: one test has them, the others see the page of a browser without WebGL.
PLAIN, DRAWING = [*QUIET, "--disable-3d-apis"], [*QUIET, "--enable-unsafe-swiftshader"]
# On a busy machine everything takes longer, and passes.
LIMIT_MS = 500_000
AT_ONCE = 40  # pairs that come within a second
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no browser; to run it: apt-get install chromium")
SIZES = {"desktop": {"width": 1280, "height": 900}, "phone": {"width": 360, "height": 740}}


class PageServer:
    """`bodyschema view` on a port of its own, which can be stopped and restarted."""

    def __init__(self, robot: Path, port: str) -> None:
        self._command = ["-m", "bodyschema", "view", "--robot", str(robot), "--port", port]
        self.address = f"http://127.0.0.1:{port}/"
        self.start()

    def start(self) -> None:
        """Start the page's process and wait until a browser may connect."""
        said, writes = os.pipe()
        with os.fdopen(said) as first, os.fdopen(writes, "w") as out:
            self._process = warm.Child(*self._command, stdout=out)
            out.close()
            assert first.readline() == f"look at {self.address}\n"

    def end(self) -> None:
        """End the process by SIGTERM, in order, even with open pages."""
        self._process.terminate()
        assert self._process.wait() == 0


def recorded(config: Config) -> Recording:
    """Return a recording of an hour, with a tool that is 5 cm off: enough to be shown at once, and then little more."""
    rows = np.arange(3_600)
    turns, begin = np.random.default_rng(3).uniform([[0.2], [0.0]], [[0.6], [6.0]], (2, 7))
    middle, swing = 0.5 * (config.robot.upper + config.robot.lower), 0.3 * (config.robot.upper - config.robot.lower)
    q = middle + swing * np.sin(turns * rows[:, None] / 4.0 + begin)
    chain = config.robot.chain.with_tool([0.03, 0.02, -0.035])
    return Recording(config.robot.joints, q, chain.positions(q), np.cumsum(np.where(rows < AT_ONCE, 0.02, 1.0)))


@dataclass(frozen=True)
class Running:
    """An upper body whose sampler and learner run."""

    robot: Path
    learner: int


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    scene = prepare(tmp_path_factory.mktemp("view") / "demo", 3)
    file, config = scene.robot_file, Config.load(scene.robot_file, {})
    recorded(config).write_csv(file.with_name("walk.csv"))
    text = file.read_text(encoding="utf-8").replace("[daemon]\n", "[daemon]\nany_step = true\n")
    # A learner that solves and replays less leaves the processor to the browser.
    assert "[learner]" not in text
    rarely = f"[learner]\nsolve_every = {AT_ONCE}\nreplays_per_pair = 1.0\n"
    file.write_text(f'{text}\n[drivers]\nrecording = "walk.csv"\n{rarely}', encoding="utf-8")
    with scene.log_file.open("wb") as log:
        both = {
            name: warm.Child("-m", "bodyschema", "run", name, "--robot", file, stderr=log)
            for name in ("sampler", "learner")
        }
    try:
        for name, process in both.items():
            while not is_alive(getattr(config.tables.zenoh, name), Keys(config.robot.name).alive(name)):
                assert process.poll() is None, scene.log_file.read_text()
        yield Running(file, both["learner"].pid)
        for process in both.values():
            process.terminate()
        assert [process.wait() for process in both.values()] == [0, 0]
    finally:
        for process in both.values():
            process.kill()


@pytest.fixture(scope="module")
def server(running: Running, free_endpoint) -> Iterator[PageServer]:
    server = PageServer(running.robot, free_endpoint().rpartition(":")[2])
    yield server
    server.end()


@pytest.fixture(scope="module")
def address(server: PageServer) -> str:
    return server.address


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright  # half a second, in every worker, if it stood above

    with sync_playwright() as playwright:
        yield playwright.chromium


@pytest.fixture(scope="module")
def browser(chromium) -> Iterator[Any]:
    browser = chromium.launch(executable_path=CHROMIUM, args=PLAIN)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def complaints() -> list[str]:
    """Return the list of what the browser complains of, and of requests to elsewhere."""
    return []


@pytest.fixture(autouse=True)
def no_complaints(complaints: list[str]) -> Iterator[None]:
    yield
    assert complaints == []


@contextmanager
def opened(browser, address: str, complaints: list[str], size: str) -> Iterator[Any]:
    context = browser.new_context(viewport=SIZES[size], color_scheme="light")
    page = context.new_page()
    page.set_default_timeout(LIMIT_MS)
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda asked: None if asked.url.startswith(address) else complaints.append(asked.url))
    page.goto(address)
    yield page
    context.close()


@pytest.fixture(scope="module")
def page(browser, address: str, complaints: list[str]) -> Iterator[Any]:
    """Yield the page, one for all tests: to load and draw it takes two seconds of CPU."""
    with opened(browser, address, complaints, "desktop") as page:
        yield page


@pytest.fixture
def drawn(chromium, address: str, complaints: list[str]) -> Iterator[Any]:
    """Yield the page in a browser with WebGL, small: each pixel is drawn in software."""
    browser = chromium.launch(executable_path=CHROMIUM, args=DRAWING)
    with opened(browser, address, complaints, "phone") as page:
        yield page
    browser.close()


def expect(locator) -> Any:
    """Return the assertions about a part of the page, which wait until they hold."""
    from playwright.sync_api import expect

    return expect(locator)


def says(page, name: str, text: str) -> None:
    expect(page.locator(name)).to_contain_text(re.compile(text), timeout=LIMIT_MS)


def test_every_panel_shows_what_runs(page) -> None:
    says(page, "#robot", "upper_body")
    says(page, "#pill-sampler", "running")
    says(page, "#pill-learner", "learning")
    says(page, "#tile-error", r"[\d.]+ mm")
    says(page, "#tile-predict", r"[\d.]+ ms")
    says(page, "#outlook", "(Enough data|More data)")
    says(page, "#arm-text", r"Sample \d+: prediction and measurement are [\d.]+ mm apart")
    says(page, "#calibration", "camera yaw")
    says(page, "#cloud-text", r"[\d,]+ samples with this tool, all learnt already: median [\d.]+ mm")
    says(page, "#error-text", r"[\d.]+ mm after [\d,]+ samples")
    says(page, "#latency-text", r"Median [\d.]+ ms")
    expect(page.locator("#error-plot canvas")).to_be_visible()
    expect(page.locator("#coverage li")).to_have_count(7)
    assert page.locator("#segments tbody tr").count() >= 1
    assert page.locator("#models tbody tr").count() >= 2
    assert page.locator("#versions tbody tr").count() >= 1


def test_pause_and_resume_are_one_button(page) -> None:
    page.click("#pause")
    says(page, "#pill-sampler", "paused")
    says(page, "#notices", "no samples are accepted until resume")
    expect(page.locator("#pause")).to_have_text("Resume")
    says(page, "#rejected", "paused")
    page.click("#pause")
    says(page, "#pill-sampler", "running")


def test_tool_change_is_confirmed_and_marked(page) -> None:
    says(page, "#error-text", "samples")
    page.click("#tool")
    page.keyboard.press("Escape")
    expect(page.locator("#tool-dialog")).to_be_hidden()
    assert "changed" not in page.locator("#error-text").inner_text()
    page.click("#tool")
    page.click("text=Yes, the tool was changed")
    says(page, "#error-text", r"(tool|something) changed( \(told\))? after [\d,]+")
    says(page, "#versions", "after a change")
    page.click("#rollback")
    says(page, "#rollback-of", "The last change")
    page.click("text=Yes, roll back")
    says(page, "#notices", "learner: ")


def test_a_diagnosis_is_begun_and_stopped_by_buttons(page) -> None:
    page.click("#diagnose")
    says(page, "#diagnosis", r"Diagnosis of the newest [\d,]+ samples")
    expect(page.locator("#diagnose")).to_be_disabled()
    page.click("#diagnosis-stop")
    says(page, "#diagnosis", "The diagnosis was stopped")
    expect(page.locator("#diagnose")).to_be_enabled()


def test_page_names_silent_learner_and_resumes(page, running: Running) -> None:
    says(page, "#pill-learner", "learning")
    os.kill(running.learner, signal.SIGSTOP)
    try:
        says(page, "#notices", "The learner has not answered since .*bodyschema run learner")
        says(page, "#pill-learner", "gone")
        expect(page.locator("#tool")).to_be_disabled()
    finally:
        os.kill(running.learner, signal.SIGCONT)
    says(page, "#pill-learner", "learning")
    expect(page.locator("#notices")).not_to_contain_text("The learner has not answered", timeout=LIMIT_MS)
    expect(page.locator("#tool")).to_be_enabled()


def test_without_webgl_the_figures_stay(page) -> None:
    expect(page.locator("#arm-none")).to_be_visible(timeout=LIMIT_MS)
    expect(page.locator("#arm")).to_be_hidden()
    says(page, "#cloud-text", "median")


@pytest.mark.soak
def test_everything_is_reached_with_the_keyboard_alone(drawn) -> None:
    page = drawn
    says(page, "#cloud-text", "median")
    expect(page.locator("#pause")).to_be_enabled()
    expect(page.locator("#tool")).to_be_enabled()
    wanted = {"pause", "tool", "diagnose", "axis", "arm", "arm-marker", "arm-reset", "cloud", "cloud-reset"}
    reached = set()
    for _ in range(60):  # once around, from wherever the focus was
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.name"))
        if wanted <= reached:
            break
    assert wanted <= reached
    expect(page.locator("#arm-none")).to_be_hidden()
    page.focus("#cloud")
    before = page.locator("#cloud").screenshot()
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    while page.locator("#cloud").screenshot() == before:
        page.wait_for_timeout(100)


@pytest.mark.parametrize(("size", "scheme"), [("desktop", "light"), ("phone", "dark")])
def test_page_fits_screen_with_readable_text(page, size: str, scheme: str) -> None:
    page.set_viewport_size(SIZES[size])
    page.emulate_media(color_scheme=scheme)
    says(page, "#cloud-text", "median")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.evaluate("(e => e.scrollHeight <= e.clientHeight)(document.querySelector('.calibration .scroll'))")
    assert page.evaluate(CONTRASTS) == []


# Texts with less contrast than the 4.5 to 1 of WCAG 2.2: relative luminance of text and background.
CONTRASTS = """() => {
  const numbers = (color) => color.match(/[\\d.]+/g).map(Number);
  const light = (color) => {
    const linear = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    const [r, g, b] = numbers(color).slice(0, 3).map((c) => linear(c / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = (e) => {
    for (; e; e = e.parentElement) {
      const color = getComputedStyle(e).backgroundColor;
      if (numbers(color)[3] !== 0) return color;
    }
    return "rgb(255, 255, 255)";
  };
  const poor = [];
  for (const e of document.querySelectorAll("body *")) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim());
    if (!own || !e.checkVisibility() || e.disabled || e.closest("svg")) continue;
    const [a, b] = [light(getComputedStyle(e).color), light(ground(e))].sort((x, y) => y - x);
    if ((a + 0.05) / (b + 0.05) < 4.5) poor.push(`${e.tagName} ${e.id || e.className}: ${e.textContent}`);
  }
  return poor;
}"""


def test_before_its_first_documents_the_page_waits(page) -> None:
    said = page.evaluate("""async () => {
      const { notices } = await import("/static/js/notices.js");
      notices({}, false);
      return [...document.querySelectorAll("#notices .notice")].map((notice) => [notice.textContent, notice.className]);
    }""")
    assert ["Waiting for the page's server…", "notice "] in said
    assert not any("does not answer" in words for words, _ in said)


def test_page_names_ended_server_and_reconnects(page, server: PageServer, complaints) -> None:
    says(page, "#pill-learner", "learning")
    server.end()
    says(page, "#notices", "The page's server does not answer")
    expect(page.locator("#pause")).to_be_disabled()
    server.start()
    expect(page.locator("#pause")).to_be_enabled(timeout=LIMIT_MS)
    expect(page.locator("#notices")).not_to_contain_text("server does not answer", timeout=LIMIT_MS)
    complaints.clear()  # of connections that were refused meanwhile
