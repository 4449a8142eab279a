"""The report in a browser: it draws, reacts, fits phones and screens, and reports no errors."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rcg_jax.report.compare import find_runs, write_comparison
from rcg_jax.report.write import write_report
from tests import report_run

webdriver = pytest.importorskip("selenium.webdriver", reason="no selenium: pip install selenium")
BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    not BROWSER or not DRIVER, reason="no Chromium; Debian packages chromium chromium-driver: make apt installs them"
)

#: How many pixels of a canvas are drawn, and how many of a colour (rgb, within 40).
COUNT = """
const canvas = arguments[0], [r, g, b] = arguments[1] || [];
const copy = document.createElement("canvas");
[copy.width, copy.height] = [canvas.width, canvas.height];
const context = copy.getContext("2d", { willReadFrequently: true });
context.drawImage(canvas, 0, 0);
const data = context.getImageData(0, 0, copy.width, copy.height).data;
let n = 0;
for (let i = 0; i < data.length; i += 4) {
  if (data[i + 3] > 60 && (r === undefined ||
      Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 40)) n++;
}
return n;
"""
GREEN, ORANGE = (0, 158, 115), (213, 94, 0)


@pytest.fixture(scope="module")
def pages(tiny: Path) -> tuple[Path, Path]:
    """A run's report and a comparison."""
    run = report_run.save_run(tiny / "runs")
    write_report(run, videos=1)
    for seed, method in ((0, "reverse"), (5, "reverse"), (0, "uniform")):
        report_run.save_run(tiny / "more", seed=seed, method=method)
    out = tiny / "comparison.html"
    write_comparison(find_runs([tiny / "more" / "tiny" / "reverse", tiny / "more" / "tiny" / "uniform"]), out)
    return run / "report.html", out


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for word in ("headless", "no-sandbox", "disable-gpu", "no-first-run", "disable-background-networking"):
        options.add_argument(f"--{word}")
    for word in ("disable-component-update", "disable-sync", "disable-dev-shm-usage"):
        options.add_argument(f"--{word}")
    options.add_argument(f"--user-data-dir={tmp_path_factory.mktemp('profile')}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def show(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens a page in a window of some width; at the end nothing may have been logged or fetched."""

    def open_page(path: Path, width: int = 1280, scheme: str = "light") -> Any:
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        feature = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", feature)
        browser.get(path.as_uri())
        wait(lambda: browser.execute_script("return document.documentElement.dataset.ready === 'true'"))
        return browser

    yield open_page
    assert browser.get_log("browser") == []
    fetched = browser.execute_script("return performance.getEntriesByType('resource').map((each) => each.name)")
    assert [name for name in fetched if not name.startswith("data:")] == []


def wait(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + 30
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


def chart(browser: Any, what: str) -> str:
    """A JavaScript expression: the chart whose canvas is labelled so."""
    return f"Chart.getChart(document.querySelector('canvas[aria-label=\"{what}\"]'))"


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("page", [0, 1])
def test_every_chart_is_drawn_and_nothing_is_wider_than_the_window(
    pages: tuple[Path, Path], show: Callable[..., Any], page: int, width: int
) -> None:
    browser = show(pages[page], width)
    canvases = browser.find_elements("css selector", "canvas")
    assert len(canvases) >= 5
    for canvas in canvases:
        assert browser.execute_script(COUNT, canvas) > 500, canvas.get_attribute("aria-label")
        assert canvas.size["width"] > 250
    inside = "const e = document.documentElement; return e.scrollWidth - e.clientWidth"
    assert browser.execute_script(inside) == 0
    right = "return Math.max(...[...document.querySelectorAll('main *')].map((e) => e.getBoundingClientRect().right))"
    assert browser.execute_script(right) <= width


def test_the_slider_moves_the_starts(pages: tuple[Path, Path], show: Callable[..., Any]) -> None:
    browser = show(pages[0])
    view = chart(browser, "starts, from above")
    shown = f"return {view}.data.datasets.map((set) => set.data.map((point) => [point.x, point.y]))"
    move = """
      const slider = document.getElementById("iteration");
      slider.value = arguments[0];
      slider.dispatchEvent(new Event("input", {bubbles: true}));
    """
    canvas = browser.find_element("css selector", 'canvas[aria-label="starts, from above"]')
    pictures = []
    for iteration in (6, 1, 4):
        browser.execute_script(move, iteration - 1)
        points = browser.execute_script(shown)
        assert [len(each) for each in points] == [4, 5, 8, 3]
        radius = np.linalg.norm(np.concatenate(points) - np.array([0.2, 0.0]), axis=1)
        np.testing.assert_allclose(radius, report_run.RADIUS[iteration], atol=2e-3)
        assert f"iteration {iteration}" in browser.find_element("css selector", ".player output").text
        assert "mastered 8" in browser.find_element("css selector", ".key").text
        pictures.append(browser.execute_script("return arguments[0].toDataURL()", canvas))
        for colour in (GREEN, ORANGE):
            assert browser.execute_script(COUNT, canvas, colour) > 50
    assert len(set(pictures)) == 3
