"""The report in a real browser: it opens without errors, every figure is drawn, and pointing links them."""

import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from report_samples import content

from fusion.report import write_report
from fusion_io.records import ImuSeries, PairEstimate

webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")

SECONDS = 25.0
SIZES = {"laptop": (1280, 800), "phone": (390, 844)}
PATIENCE_S = 90.0


def _stuck_gyro(pairs: list[PairEstimate], imu: ImuSeries) -> tuple[list[PairEstimate], ImuSeries]:
    """From 10 to 12 s the gyro repeats itself."""
    rates = imu.angular_velocity.copy()
    rates[1000:1200] = rates[1000]
    return pairs, replace(imu, angular_velocity=rates)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with everything, and a fault."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, content(SECONDS, _stuck_gyro))
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Debian's Chromium without a window; nothing is downloaded for it."""
    binary = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("needs a browser: Debian's packages chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for argument in (
        "--headless=new",
        "--no-sandbox",  # which root, in a container, cannot have
        "--disable-dev-shm-usage",
        "--enable-unsafe-swiftshader",  # draws WebGL where there is no graphics card
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield chrome
    chrome.quit()


@pytest.fixture(scope="module", params=SIZES)
def page(browser: Any, report: Path, request: pytest.FixtureRequest) -> Any:
    """The report, opened and drawn at one of the sizes."""
    width, height = SIZES[request.param]
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": request.param == "phone"}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.get(report.as_uri())
    _wait(lambda: browser.execute_script("return document.body.dataset.ready") == "yes", "the page to be drawn")
    _wait(lambda: browser.execute_script("return 'seconds' in document.body.dataset"), "the cursor")
    return browser


def _wait(condition: Any, what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.05)


def _point_at(page: Any, selector: str, x: float, y: float) -> None:
    """Move the mouse to a place of an element, in pixels from its corner, scrolled into sight."""
    page.execute_script("document.querySelector(arguments[0]).scrollIntoView({block: 'center'})", selector)
    left, top = page.execute_script(
        "const box = document.querySelector(arguments[0]).getBoundingClientRect(); return [box.left, box.top]", selector
    )
    for step in (2, 0):  # a move, not a jump to where it may be already
        event = {"type": "mouseMoved", "x": left + x + step, "y": top + y}
        page.execute_cdp_cmd("Input.dispatchMouseEvent", event)


def _seconds(page: Any) -> float:
    return float(page.execute_script("return document.body.dataset.seconds"))


def _marked(page: Any) -> list[float]:
    """The times at which the lines of all time plots stand."""
    return page.execute_script(
        """return [...document.querySelectorAll('figure.time .js-plotly-plot')].map((plot) => {
            const { xaxis } = plot._fullLayout;
            return xaxis.p2l(parseFloat(plot.querySelector('.cursor').style.left) - xaxis._offset);
        })"""
    )


def test_it_opens_without_errors_and_loads_nothing(page: Any) -> None:
    assert [entry for entry in page.get_log("browser") if entry["level"] == "SEVERE"] == []
    loaded = page.execute_script("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert [name for name in loaded if not name.startswith(("data:", "blob:"))] == []


def test_every_figure_is_drawn(page: Any) -> None:
    """Each plot has as many drawn lines, points or bars as it has visible series, and the space is not empty."""
    drawn = page.execute_script(
        """return [...document.querySelectorAll('figure .plot')].map((plot) => [
            plot.parentNode.id,
            plot._fullData?.filter((trace) => trace.visible === true).length,
            plot.querySelectorAll('.scatterlayer .trace, .barlayer .trace').length,
        ])"""
    )
    assert len(drawn) == 19
    for name, series, marks in drawn:
        if name != "space":
            assert series == marks > 0, name
    picture = np.frombuffer(page.find_element("css selector", "#space .plot").screenshot_as_png, np.uint8)
    pixels = cv2.imdecode(picture, cv2.IMREAD_COLOR).reshape(-1, 3)
    for colour in ([178, 114, 0], [0, 94, 213]):  # BGR of the pose graph and the EKF
        assert np.any(np.all(np.abs(pixels - np.array(colour)) < 20, axis=1)), colour


def test_the_map_marks_where_all_trajectories_begin_and_where_each_ends(page: Any) -> None:
    """The raw one begins where all do; the legend explains a mark once."""
    paths, marks = page.execute_script(
        """const { data } = document.querySelector('#map .plot');
        const ends = (trace) => [trace.x[0], trace.y[0], trace.x.at(-1), trace.y.at(-1)];
        const paths = ['raw', 'pose graph', 'EKF'].map((name) => ends(data.find((trace) => trace.name === name)));
        const marks = ['start', 'end'].map((name) => data.filter((trace) => trace.name === name));
        return [paths, marks.map((each) => each.map((trace) => [trace.x[0], trace.y[0], trace.showlegend]))]"""
    )
    starts, ends = marks
    assert starts == [[*paths[0][:2], True]]
    assert [end[:2] for end in ends] == [path[2:] for path in paths]
    assert [end[2] for end in ends] == [True, False, False]


def test_it_fits_the_screen(page: Any) -> None:
    assert page.execute_script("return document.documentElement.scrollWidth - innerWidth") <= 0
    wide = page.execute_script(
        "return [...document.querySelectorAll('figure, table, p')]"
        ".filter((each) => each.getBoundingClientRect().right > innerWidth + 1).length"
    )
    assert wide == 0


def test_pointing_at_a_time_marks_it_everywhere(page: Any) -> None:
    x, y = page.execute_script(
        """const { xaxis, _size: size } = document.querySelector('#nees .plot')._fullLayout;
        return [xaxis._offset + xaxis.l2p(17.3), size.t + size.h / 4]"""
    )
    _point_at(page, "#nees .plot", x, y)
    _wait(lambda: abs(_seconds(page) - 17.3) < 0.2, "the cursor")
    now = _seconds(page)
    assert np.allclose(_marked(page), now, atol=0.01)
    i, place, here, pixel = page.execute_script(
        """const plot = document.querySelector('#map .plot');
        const mark = plot.querySelector('.place').style;
        const { xaxis, yaxis } = plot._fullLayout;
        const at = (axis, length) => axis.p2l(parseFloat(length) - axis._offset);
        const place = [at(xaxis, mark.left), at(yaxis, mark.top)];
        const path = plot.data.find((trace) => trace.name === 'pose graph');
        const i = path.customdata.findIndex(([t]) => Math.abs(t - Number(document.body.dataset.seconds)) < 1e-3);
        const pixel = Math.abs(xaxis.p2l(1) - xaxis.p2l(0));
        return [i, place, [path.x[i], path.y[i]], pixel]"""
    )
    assert i == round(10 * now)
    assert np.allclose(place, here, rtol=0.0, atol=0.0055 * pixel)  # the page rounds to hundredths of a pixel
    assert f"{now:.3f} s" in page.find_element("id", "values").text
    image = page.find_element("id", "image")
    assert image.is_displayed()
    assert abs(float(image.get_attribute("title").split()[-2]) - now) <= 1.0  # there is one every two seconds


def test_pointing_at_a_place_marks_its_time_and_shows_it(page: Any) -> None:
    x, y, t = page.execute_script(
        """const plot = document.querySelector('#map .plot');
        const { xaxis, yaxis } = plot._fullLayout;
        const path = plot.data.find((trace) => trace.name === 'pose graph');
        const i = 90;
        return [xaxis._offset + xaxis.l2p(path.x[i]), yaxis._offset + yaxis.l2p(path.y[i]), path.customdata[i][0]]"""
    )
    _point_at(page, "#map .plot", x, y)
    _wait(lambda: abs(_seconds(page) - t) < 1.0, "the cursor")
    assert np.allclose(_marked(page), _seconds(page), atol=0.01)
    _wait(
        lambda: "frame" in page.execute_script("return document.querySelector('#map .hoverlayer').textContent"), "hover"
    )


def test_an_event_is_shaded_and_a_click_on_it_goes_there(page: Any) -> None:
    row = page.find_element("css selector", "tr[data-seconds]")
    assert "gyro repeats" in page.find_element("css selector", "#summary").text
    # Who clicks there has the mouse there, and not on the map, where a place under it would have its say.
    _point_at(page, "tr[data-seconds]", 5, 5)
    hover = "return document.querySelector('#map .hoverlayer').textContent"
    _wait(lambda: page.execute_script(hover) == "", "the map to be left")
    page.execute_script("arguments[0].click()", row)
    wanted = float(row.get_attribute("data-seconds"))
    _wait(lambda: abs(_seconds(page) - wanted) < 0.06, "the cursor")
    assert page.execute_script(
        "return [...document.querySelectorAll('figure.time .js-plotly-plot')]"
        ".every((plot) => plot.querySelector('.shapelayer path') !== null)"
    )


def test_the_other_back_end_can_be_chosen_and_its_error_seen_as_colour(page: Any) -> None:
    def choose(menu: str, value: str) -> None:
        page.execute_script(
            "const menu = document.getElementById(arguments[0]); menu.value = arguments[1];"
            "menu.dispatchEvent(new Event('change'))",
            menu,
            value,
        )

    def shown() -> list[str]:
        return page.execute_script(
            "return document.querySelector('#components .plot')._fullData"
            ".filter((trace) => trace.visible === true).map((trace) => trace.name)"
        )

    assert "pose graph" in shown()
    choose("focus", "ekf")
    _wait(lambda: "EKF" in shown() and "pose graph" not in shown(), "the EKF")
    choose("colour", "error")
    _wait(lambda: page.execute_script("return document.querySelectorAll('#map .colorbar').length") == 1, "the colours")
    choose("focus", "posegraph")
    choose("colour", "")
    _wait(lambda: "pose graph" in shown(), "the pose graph")


def test_it_is_dark_where_the_screen_is(page: Any) -> None:
    def prefer(scheme: str) -> None:
        feature = {"name": "prefers-color-scheme", "value": scheme}
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})

    def brightness() -> tuple[int, int]:
        """Of the page and of a figure."""
        return tuple(
            page.execute_script(
                """const sum = (colour) => colour.match(/\\d+/g).slice(0, 3).reduce((a, b) => a + Number(b), 0);
                const behind = (element) => sum(getComputedStyle(element).backgroundColor);
                return [behind(document.body), behind(document.querySelector('#nees .main-svg'))]"""
            )
        )

    prefer("dark")
    _wait(lambda: max(brightness()) < 150, "the dark")
    prefer("light")
    _wait(lambda: min(brightness()) > 600, "the light")
