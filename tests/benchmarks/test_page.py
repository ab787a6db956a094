"""The results page in a real browser: what a reader sees, hovers over and switches off."""

import json
import shutil
import time

import pandas as pd
import pytest

from benchmarks.aggregate import compare, summarise_cells
from benchmarks.page.document import page

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

RUNS = [
    f"small-2000/Hopper-noise{noise}/{algorithm}/seed{seed}"
    for noise in (0.1, 0.3)
    for algorithm in ("gac", "sac-asym")
    for seed in (0, 1)
]

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
            "learner": steps / 10 * (1 + seed) + noise + (algorithm == "gac"),
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
    arguments = {
        f"{name}, Hopper, noise 0.1": {"tau": tau, "gamma": 0.99} for name, tau in (("gac", 0.01), ("sac-asym", 0.02))
    }
    results = origin | {"hours": 1, "still_to_run": [], "arguments": arguments, "settings": {"steps": 2000}}
    results["runs"] = {run: {"seconds": 60.0} for run in RUNS}
    return page(tidy, results | {"cells": summarise_cells(tidy, "sac-asym"), **compare(tidy)}, "a page", "../runs")


def _visible_traces(browser):
    """Names of the curves that are drawn, one for each curve."""
    script = "return JSON.stringify(document.querySelector('.js-plotly-plot')._fullData.map(t => [t.name, t.visible]))"
    return [name for name, visible in json.loads(browser.execute_script(script)) if visible is True]


def test_what_was_compared_and_who_wins_are_on_the_first_screen(browser):
    from selenium.webdriver.common.by import By

    assert browser.title == "a page"
    short = browser.find_element(By.CSS_SELECTOR, ".short")
    assert short.rect["y"] + short.rect["height"] < 500
    lead, first, *_ = browser.find_element(By.TAG_NAME, "body").text.splitlines()[1:]
    assert lead == "gac and sac-asym on Hopper, sensor noise 0.1 and 0.3: 2,000 environment steps, 2 seeds of each."
    assert first == "gac has the highest mean return at the end in 2 of 2 cells."
    assert "with probability" in short.text
    assert "2 seeds are few: an interval of their mean is 12.7 standard errors" in short.text


def test_curves_tables_and_configuration_are_shown_without_errors(browser):
    from selenium.webdriver.common.by import By

    drawn = len(browser.find_elements(By.CSS_SELECTOR, ".scatterlayer .trace"))
    assert drawn == 2 * (2 * 4 + 1), "in two cells, of two algorithms two seeds, their mean and its band, and one guider"
    assert [title.text for title in browser.find_elements(By.CSS_SELECTOR, ".annotation-text")] == [
        "Hopper, noise 0.1",
        "Hopper, noise 0.3",
    ]
    returns, overall, differences = browser.find_elements(By.TAG_NAME, "table")
    assert "300" in returns.text
    assert "above sac-asym" in overall.text
    assert "python -m benchmarks.launch a-suite.yml" in browser.find_element(By.TAG_NAME, "pre").text
    for fold in browser.find_elements(By.TAG_NAME, "summary"):
        fold.click()
    assert differences.text.splitlines() == ["argument gac sac-asym", "tau 0.01 0.02"]
    assert "gamma: 0.99" in browser.find_elements(By.TAG_NAME, "pre")[1].text, "what all share"
    assert browser.find_element(By.LINK_TEXT, RUNS[0]).get_attribute("href").endswith(f"/runs/{RUNS[0]}")
    assert _sticks_out(browser) <= 0, "nothing sticks out to the right"
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def test_every_tab_draws_its_curves_under_named_axes(browser):
    expected = {
        "Returns over seconds": ("return", "seconds of one core"),
        "Guider over learner": ("guider's return - learner's", "environment steps"),
        "KL": ("KL / target_kl", "environment steps"),
        "Performance profile": ("share of runs above it", "normalised score"),
        "Returns": ("return", "environment steps"),
    }
    from selenium.webdriver.common.by import By

    assert {button.text for button in browser.find_elements(By.CSS_SELECTOR, "nav button")} == set(expected)
    for name, titles in expected.items():
        _show(browser, name)
        axes = """const {xaxis, yaxis} = document.querySelector('.js-plotly-plot')._fullLayout;
            return [yaxis.title.text, xaxis.title.text]"""
        assert tuple(browser.execute_script(axes)) == titles
        assert browser.find_elements(By.CSS_SELECTOR, ".scatterlayer .trace")
        assert browser.find_element(By.ID, "caption").text
    times = "return document.querySelector('.js-plotly-plot').data.map(t => [t.name, t.x])"
    _show(browser, "Returns over seconds")
    assert ["gac", [30, 60]] in browser.execute_script(times), "60 seconds, half of them by half of the steps"
    _show(browser, "Returns")


def test_a_click_on_a_columns_name_sorts(browser):
    from selenium.webdriver.common.by import By

    table = browser.find_element(By.TAG_NAME, "table")
    heads = {head.text: head for head in table.find_elements(By.TAG_NAME, "th")}
    for order in (-1, 1):
        heads["mean at the end"].click()
        column = list(heads).index("mean at the end")
        script = "return [...arguments[0].tBodies[0].rows].map(row => Number(row.cells[arguments[1]].dataset.value))"
        values = browser.execute_script(script, table, column)
        assert values == sorted(values, key=lambda value, order=order: order * value)
    best = [row.text.split()[2] for row in table.find_elements(By.CSS_SELECTOR, "tr.best")]
    assert best == ["gac", "gac"], "in bold in either cell"


def test_a_phone_has_one_column_and_the_dark_mode_dark_paper(browser):
    from selenium.webdriver.common.by import By

    phone = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", phone)
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
    try:
        places = "return document.querySelector('.js-plotly-plot')._fullLayout.yaxis2.domain[1]"
        _wait(lambda: browser.execute_script(places) < 0.6)
        assert _sticks_out(browser) <= 0
        paper = browser.find_element(By.TAG_NAME, "body").value_of_css_property("background-color")
        assert max(map(int, paper[paper.index("(") + 1 :].split(",")[:3])) < 40
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    _wait(lambda: browser.execute_script(places) > 0.4)


def test_a_click_on_a_name_switches_its_curves_off_and_on(browser):
    from selenium.webdriver.common.by import By

    toggle = browser.find_elements(By.CSS_SELECTOR, ".legendtoggle")[0]
    before = _visible_traces(browser)
    assert sum(name.startswith("gac") for name in before) == 2 * 5
    for expected in ([name for name in before if not name.startswith("gac")], before):
        toggle.click()
        _wait(lambda expected=expected: _visible_traces(browser) == expected)
        toggle = browser.find_elements(By.CSS_SELECTOR, ".legendtoggle")[0]


def test_hovering_tells_values_of_all_algorithms_at_a_step(browser):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    where = """const plot = document.querySelector('.js-plotly-plot'), {xaxis, yaxis} = plot._fullLayout;
        return [xaxis.d2p(1000) - xaxis._length / 2, yaxis.d2p(150.1) - yaxis._length / 2]"""
    x, y = browser.execute_script(where)  # of a point in the first cell, from the middle of that cell
    cell = browser.find_element(By.CSS_SELECTOR, ".nsewdrag")
    for inwards in (4, 3):  # a pointer that moves
        ActionChains(browser).move_to_element_with_offset(cell, int(x) + inwards, int(y) + inwards).perform()
    shown = "return [...document.querySelectorAll('.hoverlayer .legend')].map(label => label.textContent).join()"
    _wait(lambda: "sac-asym : 150.1" in browser.execute_script(shown))
    assert "seeds 100.1, 200.1" in browser.execute_script(shown)


def _show(browser, tab):
    from selenium.webdriver.common.by import By

    browser.find_element(By.CSS_SELECTOR, f'nav button[data-figure="{tab}"]').click()
    selected = "return document.querySelector('nav button[aria-selected=true]').textContent"
    _wait(lambda: browser.execute_script(selected) == tab)


def _sticks_out(browser):
    return browser.execute_script("return document.documentElement.scrollWidth - window.innerWidth")


def _wait(condition, seconds=20):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)
