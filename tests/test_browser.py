"""The report in a browser: charts answer, films play, nothing is wrong, everyone can read it.

It needs Chromium (or Chrome) on PATH, and `pip install playwright axe-playwright-python`; without
them it is skipped, and says why.
"""

import csv
import io
import shutil
from dataclasses import replace

import pytest
from test_report import full_page, rollout, team, trained, without_a_map

from marlyap.report.data import Claim, Page
from marlyap.report.page import html


api = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe judges the page")
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
PROGRAM = next((found for name in NAMES if (found := shutil.which(name))), None)
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium on PATH")
QUIET = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
QUIET += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
SIZES = {"desk": (1280, 900), "phone": (390, 844)}


def several() -> Page:
    """Two configurations on one game, and a game without a map; two films of one start."""
    runs = [trained(s, a) for a in ("masac", "masac-lyapunov") for s in range(2)]
    runs = [replace(run, game="rendezvous", finals=(0.01, 0.02, 0.4)) for run in runs]
    other = replace(trained(0, "droop"), game="frequency", unit="Hz")
    pair = [
        replace(rollout(7, label="start 7", run=who, gain=gain), shot="one", title="best")
        for who, gain in (("masac", 0.5), ("masac-lyapunov", 2.0))
    ]
    worst = replace(rollout(3, label="worst for reach", run="masac"), shot="case")
    said = {"claim": "it arrives", "holds": True, "bound": 0.9, "shot": "case"}
    kinds = {"reach": "statistical", "decrease": "proved", "seen": "observed"}
    claims = [Claim(name=name, evidence=kind, **said) for name, kind in kinds.items()]
    return replace(
        full_page(),
        groups=(team("masac"), team("masac-lyapunov"), team("droop", unit="Hz")),
        runs=(*runs, other),
        films=(*pair, without_a_map(), worst),
        claims=tuple(claims),
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The page as a file."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(html(several()), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def browser():
    with api.sync_playwright() as play:
        found = play.chromium.launch(executable_path=PROGRAM, args=QUIET)
        yield found
        found.close()


@pytest.fixture
def page(browser, file):
    """The report, opened; whatever the console complains of fails the test."""
    with opened(browser, file) as shown:
        yield shown


class opened:
    """A tab with the report, which must be silent."""

    def __init__(self, browser, file, size="desk", scheme="light"):
        width, height = SIZES[size]
        self.context = browser.new_context(
            viewport={"width": width, "height": height},
            color_scheme=scheme,
            has_touch=size == "phone",
            accept_downloads=True,
        )
        self.file, self.said = file, []

    def __enter__(self):
        tab = self.context.new_page()
        wrong = lambda message: self.said.append(message.text)
        tab.on("console", lambda m: wrong(m) if m.type in ("error", "warning") else None)
        tab.on("pageerror", lambda error: self.said.append(str(error)))
        tab.on("request", lambda r: None if r.url.startswith(("file:", "data:", "blob:"))
               else self.said.append(f"asked the network for {r.url}"))  # fmt: skip
        tab.goto(self.file.as_uri())
        tab.wait_for_selector("html[data-charts=ready][data-player=ready]")
        return tab

    def __exit__(self, *_):
        self.context.close()
        assert self.said == []


def until(page, true):
    """Wait for something; the page's policy forbids Playwright's own way, which is eval."""
    for _ in range(600):
        if true():
            return
        page.wait_for_timeout(100)
    raise AssertionError("it did not come")


def ranges(page, chart="chart-0"):
    """What a chart shows: left, right, bottom, top."""
    return page.evaluate(
        """(id) => { const f = marlyapCharts.figures.get(id);
        return [f.x_range.start, f.x_range.end, f.y_range.start, f.y_range.end]; }""",
        chart,
    )


def visible(page, chart="chart-0"):
    return page.evaluate(
        "(id) => marlyapCharts.figures.get(id).renderers.filter((r) => r.visible).length", chart
    )


def place(page, chart="chart-0"):
    found = page.locator(f"#{chart}")
    found.scroll_into_view_if_needed()
    page.wait_for_timeout(200)
    return found.bounding_box()


def test_a_drag_zooms_and_a_double_click_shows_all_again(page):
    whole, box = ranges(page), place(page)
    page.mouse.move(box["x"] + 120, box["y"] + 60)
    page.mouse.down()
    page.mouse.move(box["x"] + 240, box["y"] + 160, steps=8)
    page.mouse.up()
    until(page, lambda: ranges(page)[0] > whole[0])
    near = ranges(page)
    assert whole[0] < near[0] < near[1] < whole[1]
    page.mouse.dblclick(box["x"] + 180, box["y"] + 100)
    until(page, lambda: abs(ranges(page)[0] - whole[0]) < 1)
    assert ranges(page) == pytest.approx(whole)


SPOT = """() => { // where a point of the first curve is, in pixels of its chart
  const figure = marlyapCharts.figures.get("chart-0"), { x, y } = figure.renderers[0].data_source.data;
  const { left, top, width, height } = Bokeh.index.find_one_by_id(figure.id).frame.bbox, k = 20;
  const share = (range, value) => (value - range.start) / (range.end - range.start);
  return [left + width * share(figure.x_range, x[k]), top + height * (1 - share(figure.y_range, y[k]))];
}"""  # noqa: E501
TOLD = """() => { // the text inside the charts, where tooltips are
  const within = (root) => [...root.querySelectorAll("*")].flatMap((element) => {
    const inside = element.shadowRoot;
    return inside ? [inside.textContent, ...within(inside)] : [];
  });
  return within(document).join(" ");
}"""


def test_pointing_at_a_curve_shows_its_values(page):
    box, (x, y) = place(page), page.evaluate(SPOT)
    assert "10,240" not in page.evaluate(TOLD) and "masac, seed 0" not in page.evaluate(TOLD)
    page.mouse.move(box["x"] + x - 30, box["y"] + y - 20)
    page.mouse.move(box["x"] + x, box["y"] + y, steps=5)
    until(page, lambda: "masac, seed 0" in page.evaluate(TOLD))
    assert "environment steps" in page.evaluate(TOLD)


def test_a_switch_hides_a_run_in_every_chart(page):
    before = [visible(page, f"chart-{k}") for k in (0, 1)]
    button = page.locator('[data-team="0"]')
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    after = [visible(page, f"chart-{k}") for k in (0, 1)]
    assert all(b < a for a, b in zip(before, after, strict=True))
    button.click()
    assert [visible(page, f"chart-{k}") for k in (0, 1)] == before
    page.locator("summary").first.click()
    page.locator('[data-member="0"]').click()
    assert visible(page) == before[0] - 2  # its line and its points


@pytest.mark.parametrize("which", ["chart-0", "level-0"])
def test_every_chart_gives_its_data(page, which):
    with page.expect_download() as waiting:
        page.locator(f'.csv[data-chart="{which}"]').click()
    rows = list(csv.reader(io.StringIO(waiting.value.path().read_text())))
    if which == "level-0":
        assert rows[0] == ["x", "y", "V"] and len(rows) == 1 + 21 * 21
        assert [float(v) for v in rows[1]] == pytest.approx([-1, -1, 3])
    else:
        assert rows[0][:3] == ["curve", "environment steps", "Success during training (%)"]
        one = [row for row in rows if row[0] == "masac, seed 0"]
        assert len(one) == 30 and float(one[0][1]) == 10_240


def test_the_film_plays_steps_and_compares(page):
    time = lambda: page.locator(".readout b").first.inner_text()
    assert page.locator(".pane").count() == 2  # the first two of the same start
    assert page.locator(".pane .who b").all_inner_texts() == ["masac", "masac-lyapunov"]
    page.locator(".play").click()
    until(page, lambda: time() > "0.3 s")
    page.locator(".play").click()
    page.locator(".player").press("Home")
    page.locator(".player").press("ArrowRight")
    assert time() == "0.1 s"
    page.locator(".drivers button").first.click()
    assert page.locator(".pane .who b").all_inner_texts() == ["masac-lyapunov"]
    assert time() == "0.1 s"
    page.locator(".episodes button").nth(1).click()  # a game without a map
    assert page.locator(".pane .scene").first.is_hidden()
    with page.expect_download() as waiting:
        page.locator(".controls .csv").click()
    assert waiting.value.path().read_text().startswith("driver,time (s),value,agent,number\n")


def test_a_certificate_shows_its_worst_case(page):
    page.locator(".worst").first.click()
    pressed = page.locator('.episodes [aria-pressed="true"] b')
    assert pressed.inner_text() == "worst for reach"
    kinds = page.locator(".card .evidence").all_text_contents()
    assert kinds == ["statistical", "proved", "observed"]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_everyone_can_read_it(browser, file, size, scheme):
    """Axe finds no fault of level A or AA; nothing sticks out of the window."""
    with opened(browser, file, size, scheme) as tab:
        width = SIZES[size][0]
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
        rules = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]}
        found = axe.Axe().run(tab, options=rules).response["violations"]
        faults = [
            f"{v['id']}: {n['target']} {n['failureSummary']}" for v in found for n in v["nodes"]
        ]
        assert faults == []


@pytest.mark.slow
def test_curves_follow_the_theme(browser, file):
    colour = "marlyapCharts.figures.get('chart-0').renderers[0].glyph.line_color.value"
    seen = []
    for scheme in ("light", "dark"):
        with opened(browser, file, "desk", scheme) as tab:
            seen.append(tab.evaluate(colour))
    assert seen == ["#0072b2", "#56b4e9"]


def test_without_the_film_or_charts_nothing_complains(browser, tmp_path):
    path = tmp_path / "bare.html"
    path.write_text(html(Page(title="Nothing yet")), encoding="utf-8")
    said = []
    tab = browser.new_page()
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.goto(path.as_uri())
    assert said == [] and tab.title() == "Nothing yet"
    tab.close()
