"""The page of a run in a real browser: it opens without an error, and hands change the frame."""

import json
import re
import shutil
import subprocess
import tempfile

import judged
import pytest

from taojax.audit import figures
from taojax.audit.html import names_of_signals
from taojax.audit.report import write_summary

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


needs_browser = pytest.mark.skipif(BROWSER is None, reason="no chromium to open the page with")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return judged.evaluated(tmp_path_factory.mktemp("case"))


def opened(page, fragment="", script="", *flags):
    """Open a page in a browser; return its document and what it wrote to the console."""
    with tempfile.TemporaryDirectory() as profile:
        if script:
            whole = page.read_text().replace("</body>", f"<script>{script}</script></body>")
            page = page.with_name("scripted.html")
            page.write_text(whole)
        words = (
            BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
            "--disable-background-networking", "--disable-dev-shm-usage", "--enable-logging=stderr",
            "--virtual-time-budget=3000", f"--user-data-dir={profile}", "--window-size=1200,1600",
            *flags, "--dump-dom", f"file://{page}{fragment}",
        )  # fmt: skip
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def frame_of(document):
    return int(re.search(r'<section id="route"[^>]*data-frame="(\d+)"', document)[1])


@needs_browser
def test_a_fragment_chooses_the_frame_and_the_console_stays_silent(case):
    document, console = opened(case[0] / "report.html", "#frame=123")
    assert console == []
    assert frame_of(document) == 123
    verdicts = case[1].judgement.verdicts
    assert f">{verdicts['reason'][123]}</span>".replace("<=", "&lt;=") in document
    assert re.search(r'id="route-badge"[^>]*>' + str(verdicts["verdict"][123]), document)
    assert not re.search(r'<section id="route"[^>]*hidden', document)


FOLDS = """
const open = () => [...document.querySelectorAll("details.fold[open]")].map((fold) => fold.id);
const seen = { start: open() };
location.hash = "#frame=99";
setTimeout(() => {
  seen.frame = open();
  dispatchEvent(new Event("beforeprint")); seen.print = open().length;
  dispatchEvent(new Event("afterprint")); seen.after = open();
  const told = document.createElement("pre");
  told.id = "seen"; told.textContent = JSON.stringify(seen);
  document.body.append(told);
}, 400);
"""


@needs_browser
def test_all_is_folded_until_asked_for_and_open_on_paper(case, tmp_path):
    shutil.copy(case[0] / "report.html", tmp_path / "report.html")
    document, console = opened(tmp_path / "report.html", "", FOLDS)
    assert console == []
    seen = json.loads(re.search(r'<pre id="seen">(.*?)</pre>', document)[1])
    assert seen == {"start": [], "frame": ["along"], "print": 7, "after": ["along"]}
    assert frame_of(document) == 99
    document, console = opened(case[0] / "report.html", "#figures")
    assert console == []
    assert '<details class="fold" id="figures" open="">' in document


CLICKS = """
const seen = {}, frame = () => Number(document.getElementById("route").dataset.frame);
const at = (id) => document.getElementById(id);
const press = (key, more) => document.body.dispatchEvent(
  new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...more }));
const click = (id, x, y) => at(id).dispatchEvent(
  new MouseEvent("click", { clientX: x, clientY: y, bubbles: true }));
const spot = () => {
  const box = document.querySelector("circle.here").getBoundingClientRect();
  return [box.left + box.width / 2, box.top + box.height / 2];
};
seen.start = frame();
const place = spot();
at("route-scrub").value = 200;
at("route-scrub").dispatchEvent(new Event("input"));
seen.scrubbed = frame();
click("route-map", ...place);
seen.map = frame();
press("ArrowRight"); seen.right = frame();
press("ArrowLeft"); press("ArrowLeft"); seen.left = frame();
press("ArrowRight", { shiftKey: true }); seen.ten = frame();
const box = at("route-strip").getBoundingClientRect();
click("route-strip", box.left + box.width * 0.5 + 2, box.top + 3);
seen.strip = frame();
at("route-frame").value = 77;
at("route-frame").dispatchEvent(new Event("change"));
seen.typed = frame();
seen.candidates = document.querySelectorAll("#route-moving .candidate").length;
seen.terms = document.querySelectorAll("#route-terms tr").length;
seen.signals = document.querySelectorAll("#route-signals tr").length;
at("route-in").click(); at("route-in").click();
const middle = spot(), view = at("route-map").getBoundingClientRect();
seen.off = Math.hypot(
  middle[0] - view.left - view.width / 2, middle[1] - view.top - view.height / 2);
document.querySelector("#route-key button").click();
seen.next = frame();
seen.rods = document.querySelectorAll("#route-terms .rod").length;
seen.reason = at("route-reason").textContent;
const named = document.querySelectorAll("#route-signals td:first-child");
seen.named = [...named].map((cell) => cell.textContent);
seen.high = Number(at("route-map").getAttribute("viewBox").split(" ")[3]);
press("ArrowRight", { ctrlKey: true }); seen.ctrl = frame();
for (let i = 0; i < 500; i++) press("ArrowRight");
seen.last = frame();
setTimeout(() => {
  seen.hash = location.hash;
  const told = document.createElement("pre");
  told.id = "seen"; told.textContent = JSON.stringify(seen);
  document.body.append(told);
}, 800);
"""


@needs_browser
def test_clicking_scrubbing_and_keys_change_the_shown_frame(case, tmp_path):
    shutil.copy(case[0] / "report.html", tmp_path / "report.html")
    document, console = opened(tmp_path / "report.html", "#frame=50", CLICKS)
    assert console == []
    seen = json.loads(re.search(r'<pre id="seen">(.*?)</pre>', document)[1])
    judgement = case[1].judgement
    assert (seen["start"], seen["scrubbed"], seen["hash"]) == (50, 200, "#frame=239")
    assert (seen["map"], seen["right"], seen["left"], seen["ten"]) == (50, 51, 49, 59)
    assert (seen["strip"], seen["typed"], seen["last"]) == (120, 77, 239)
    assert seen["candidates"] == 100
    assert seen["terms"] == len(judgement.detector.columns)
    assert seen["signals"] == len(judgement.metrics["signal"])
    assert seen["off"] < 1.0
    assert seen["rods"] == seen["terms"]
    assert seen["reason"] == judgement.verdicts["reason"][seen["next"]]
    assert set(seen["named"]) <= set(names_of_signals())
    # The road is straight: its map is no square with a thread in it.
    assert seen["high"] == 220
    assert seen["ctrl"] == seen["next"]
    # The first kind in the key is the first outcome that occurs, and test frames come first.
    kinds = [name for name in figures.plots.OUTCOMES if (judgement.outcome == name).any()]
    assert judgement.outcome[seen["next"]] == kinds[0]


@needs_browser
def test_an_error_on_the_page_would_be_noticed(case, tmp_path):
    shutil.copy(case[0] / "report.html", tmp_path / "report.html")
    _, console = opened(tmp_path / "report.html", "", "nowhere();")
    assert any("nowhere is not defined" in line for line in console)


@needs_browser
def test_the_summary_opens_without_a_route_and_without_an_error(case, tmp_path):
    done = case[1]
    write_summary(tmp_path, {"default": done, "h3": done})
    document, console = opened(tmp_path / "report.html")
    assert console == []
    assert 'href="h3/report.html"' in document
    assert 'id="route"' not in document
    assert "<abbr title=" in document.split('<ul class="found">')[1].split("</ul>")[0]
