"""The results page in a real browser: what a reader sees, hovers over and switches off."""

import json
import shutil
import time

import pandas as pd
import pytest

from benchmarks.aggregate import compare, summarise_cells
from benchmarks.report import page

DRIVER = shutil.which("chromedriver")
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1200,1000",
)

pytestmark = pytest.mark.skipif(DRIVER is None, reason="needs Chromium and its driver (Debian: chromium, chromium-driver)")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for option in (*OPTIONS, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    browser.implicitly_wait(20)
    path = tmp_path_factory.mktemp("page") / "results.html"
    path.write_text(_page())
    browser.get(path.as_uri())
    yield browser
    browser.quit()


def _page():
    rows = [
        {
            "task": "Hopper",
            "noise": noise,
            "algorithm": algorithm,
            "seed": seed,
            "timesteps": steps,
            "learner": steps / 10 * (1 + seed) + noise,
        }
        for noise in (0.1, 0.3)
        for algorithm in ("gac", "sac-asym")
        for seed in (0, 1)
        for steps in (1000, 2000)
    ]
    tidy = pd.DataFrame(rows)
    tidy["guider"] = tidy.learner.where(tidy.algorithm == "gac") + 50
    tidy = tidy.assign(kl=0.01, target_kl=0.01)
    origin = {
        "command": "python -m benchmarks.launch a-suite.yml",
        "made_with": [{"commit": "abc", "versions": {"torch": "2"}}],
    }
    results = origin | {"hours": 1, "still_to_run": [], "arguments": {"gac": {"tau": 0.01}}, "runs": {"small-1/a run": {}}}
    return page(tidy, results | {"cells": summarise_cells(tidy, "sac-asym"), **compare(tidy)}, "a page", "../runs")


def _visible_traces(browser):
    """Names of the curves that are drawn, one for each curve."""
    script = "return JSON.stringify(document.querySelector('.js-plotly-plot')._fullData.map(t => [t.name, t.visible]))"
    return [name for name, visible in json.loads(browser.execute_script(script)) if visible is True]


def test_curves_tables_and_configuration_are_shown_without_errors(browser):
    from selenium.webdriver.common.by import By

    assert browser.title == "a page"
    drawn = len(browser.find_elements(By.CSS_SELECTOR, ".scatterlayer .trace"))
    assert drawn == 2 * (2 * 4 + 1), "in two cells, of two algorithms two seeds, their mean and its band, and one guider"
    assert [title.text for title in browser.find_elements(By.CSS_SELECTOR, ".annotation-text")] == [
        "Hopper, noise 0.1",
        "Hopper, noise 0.3",
    ]
    tables = browser.find_elements(By.TAG_NAME, "table")
    assert "300" in tables[0].text
    assert "probability of improvement" in tables[1].text
    assert "python -m benchmarks.launch a-suite.yml" in browser.find_element(By.TAG_NAME, "pre").text
    assert browser.find_element(By.LINK_TEXT, "small-1/a run").get_attribute("href").endswith("/runs/small-1/a%20run")
    width = browser.execute_script("return document.documentElement.scrollWidth - window.innerWidth")
    assert width <= 0, "nothing sticks out to the right"
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_a_click_on_a_name_switches_its_curves_off_and_on(browser):
    from selenium.webdriver.common.by import By

    toggle = browser.find_elements(By.CSS_SELECTOR, ".legendtoggle")[0]
    before = _visible_traces(browser)
    assert sum(name.startswith("gac") for name in before) == 2 * 5
    for expected in ([name for name in before if not name.startswith("gac")], before):
        toggle.click()
        _wait(lambda expected=expected: _visible_traces(browser) == expected)
        toggle = browser.find_elements(By.CSS_SELECTOR, ".legendtoggle")[0]


def test_hovering_tells_a_runs_name_and_value(browser):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    where = """const plot = document.querySelector('.js-plotly-plot'), {xaxis, yaxis} = plot._fullLayout;
        return [xaxis.d2p(2000) - xaxis._length / 2, yaxis.d2p(400.1) - yaxis._length / 2]"""
    x, y = browser.execute_script(where)  # of a point in the first cell, from the middle of that cell
    cell = browser.find_element(By.CSS_SELECTOR, ".nsewdrag")
    for inwards in (4, 3):  # a pointer that moves
        ActionChains(browser).move_to_element_with_offset(cell, int(x) - inwards, int(y) + inwards).perform()
    shown = "return [...document.querySelectorAll('.hoverlayer .hovertext')].map(label => label.textContent)"
    _wait(lambda: any("seed 1" in label and "400.1" in label for label in browser.execute_script(shown)))


def _wait(condition, seconds=20):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)
