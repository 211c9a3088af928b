"""The page of a run: small, self-contained, and every number defined."""

import base64
import json
import re
from html.parser import HTMLParser

import judged
import numpy as np
import pytest

from taojax.audit import figures, frame_explorer
from taojax.audit.evaluate import evaluate
from taojax.audit.html import Page, glossary, marked, names_of_signals, render
from taojax.audit.opening import TOO_SHORT, UNKNOWN, sentence
from taojax.audit.summary_text import NO_SHIELD, find_words, span, warnings
from taojax.files import records
from taojax.risk import DOUBT_COUNTS


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return judged.evaluated(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def held(case):
    run, done = case
    sealed = records.read_run(run)
    return (
        sealed,
        done,
        json.loads(frame_explorer.route_json(done.judgement, sealed.index, sealed.similarity)),
    )


def unpacked(text, kind):
    return np.frombuffer(base64.b64decode(text), dtype=kind)


class _Seen(HTMLParser):
    """Collect what defines the numbers of a page, and the names that need a definition."""

    def __init__(self):
        super().__init__()
        self.cards, self.heads, self.open = [], [], []
        self.columns, self.defined, self.terms = set(), set(), {}
        self.inside, self.table, self.column, self.last = "", [], 0, ""

    def handle_starttag(self, tag, attrs):
        facts = dict(attrs)
        self.inside = tag if tag in ("th", "td", "dt", "dd", "small") else self.inside
        if tag == "table":
            self.table = []
        if tag == "tr":
            self.column = -1
        if tag in ("th", "td"):
            self.column += 1
        if facts.get("class", "").split()[:1] == ["card"]:
            self.cards.append(facts.get("title", ""))
        if tag == "abbr" and self.open and self.open[-1] == "th":
            self.heads.append(facts.get("title", ""))
        if tag in ("th", "abbr"):
            self.open.append(tag)

    def handle_data(self, data):
        text = data.strip()
        if not text:
            return
        if self.inside == "th":
            self.table.append(text)
            self.columns.add(text)
        if self.inside == "td" and self.column == 0 and self.table[0] == "signal":
            self.columns.add(text)
        if self.inside == "dt":
            self.last = text
            self.defined.add(text)
        if self.inside == "dd":
            self.terms[self.last] = self.terms.get(self.last, "") + text

    def handle_endtag(self, tag):
        self.inside = "" if tag == self.inside else self.inside
        if self.open and self.open[-1] == tag:
            self.open.pop()


def test_every_number_has_a_definition_and_the_command_that_made_it(case):
    run, done = case
    page = _Seen()
    page.feed((run / "report.html").read_text())
    tables = [title for title in page.heads if "made by" in title]
    assert len(page.cards) == 3
    assert len(tables) > 40
    for title in (*page.cards, *tables):
        meaning, _, command = title.partition(" — made by: ")
        assert len(meaning) > 3 or "frame" in meaning, title
        assert command == done.command


def test_every_name_in_tables_figures_and_panel_is_in_the_glossary(case, held):
    run, done = case
    html = (run / "report.html").read_text()
    page = _Seen()
    page.feed(html)
    panel = {"value", "log odds", "rank", "map row", "similarity", "from truth", "own threshold"}
    assert {"decided", "far_at_95", "top1_w5", "tao_rank", "auroc"} <= page.columns
    assert page.columns - panel - page.defined == set()
    shown = {signal["name"] for signal in held[2]["signals"]}
    shown |= {*figures.TRACED, *figures.STRICT, *done.judgement.detector.columns}
    assert {"tao_rank_vel", "entropy", "fused"} <= shown
    assert shown - page.defined == set()
    assert all(len(page.terms[name]) > 8 for name in shown)
    # Names that stand in a sentence, a reason or a definition.
    said = [*done.sentences, *done.judgement.verdicts["reason"], *page.terms.values()]
    words = {w for text in said for w in re.findall(r"[a-z]+[0-9]*(?:_[a-z0-9]+)+", text)}
    known = {"map_recall", "map_poses", "r_in", "r_out", "r_in_m", "r_out_m", "s_1", "s_2"}
    assert words - page.defined - known - {"warming_up", "no_candidates"} - facts_of(page) == set()


def facts_of(page):
    """Names in the section of settings: they are keys of the judge's configuration."""
    return set(re.findall(r"[a-z]+(?:_[a-z0-9]+)+", " ".join(
        page.terms.get(name, "") for name in ("judge's settings", "sha256", "judged by", "command")
    )))  # fmt: skip


def test_where_the_data_come_from_is_said_quietly_and_warnings_are_not(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "draw", lambda judgement: ())
    run, truth = judged.seal(tmp_path, n=12, notes=("odometry simulated",))
    html = (evaluate(run, truth, judged.config()).run / "report.html").read_text()
    note = html.split('id="notes"')[1].split("</details>")[0]
    # Beside the heading, where it is read without opening, and in the list.
    assert note.count("odometry simulated") == html.count("odometry simulated") == 2
    alarms = re.findall(r'<(?:p|li) class="[^"]*warn[^"]*">(.*?)</(?:p|li)>', html, re.DOTALL)
    assert TOO_SHORT in [re.sub(r"<[^>]*>", "", text).strip() for text in alarms]


def test_a_healthy_run_alarms_nobody_and_a_useless_one_does(case):
    judgement = case[1].judgement
    html = (case[0] / "report.html").read_text()
    assert ("warn" in re.sub(r"<style>.*?</style>", "", html, flags=re.DOTALL)) == bool(
        warnings(judgement)
    )
    test = judgement.splits.name == "test"
    verdicts = judgement.verdicts | {
        "verdict": np.where(test, "accept", judgement.verdicts["verdict"])
    }
    blind = judgement._replace(
        verdicts=verdicts, outcome=np.where(test, "accepted_wrong", judgement.outcome)
    )
    assert NO_SHIELD in warnings(blind)
    assert find_words(blind)[0] == sentence(blind) in warnings(blind)


def test_an_interval_of_no_width_is_called_unknown_and_explained(case):
    row = {"far_lo": 0.0, "far_hi": 0.0, "auroc_lo": 0.1, "auroc_hi": 0.2}
    assert span(row, "far").startswith(UNKNOWN)
    assert span(row, "auroc") == "95 % interval 0.100 to 0.200"
    assert UNKNOWN in glossary()
    assert "not bounded" not in (case[0] / "report.html").read_text()


def test_without_javascript_everything_but_the_route_is_there(case):
    run, done = case
    html = (run / "report.html").read_text()
    still = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    assert re.search(r'<section id="route"[^>]* hidden>', still)
    assert "<noscript>" in still
    assert still.count("<table>") > 8
    plain = re.sub(r"&[#\w]+;|<[^>]*>", "", still)
    for told in done.sentences:
        assert re.sub(r"[<>&'\"]", "", told) in plain


def test_the_page_reaches_for_nothing_outside_itself(case):
    html = (case[0] / "report.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:|#)", html)
    assert not re.search(r"@import|url\((?!#)|fetch\(|XMLHttpRequest|import\(", html)
    assert set(re.findall(r"https?://[^\"' <]+", html)) <= {"http://www.w3.org/2000/svg"}


def test_a_thousand_frames_stay_below_a_megabyte_and_a_half(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "draw", lambda judgement: ())
    run, truth = judged.seal(tmp_path, n=1000)
    evaluate(run, truth, judged.config(n_bootstrap=10))
    assert (run / "report.html").stat().st_size < 1_500_000


def test_the_route_holds_the_sealed_candidates_and_the_judged_frames(held):
    sealed, done, found = held
    judgement, n = done.judgement, 240
    rows = unpacked(found["candidates"]["row"], "<u2").reshape(n, -1).astype(int) - 1
    np.testing.assert_array_equal(rows, sealed.index[:, : rows.shape[1]])
    low, high = found["candidates"]["low"], found["candidates"]["high"]
    alike = (
        unpacked(found["candidates"]["alike"], "<u2").reshape(n, -1) / 65535 * (high - low) + low
    )
    known = rows >= 0
    np.testing.assert_allclose(alike[known], sealed.similarity[known], atol=1e-4)
    truth = unpacked(found["truth"], "<f4").reshape(n, 2) + np.array(found["origin"])
    np.testing.assert_allclose(truth, judgement.query_m, atol=1e-3)
    values = unpacked(found["values"], "<f4").reshape(-1, n)
    names = [signal["name"] for signal in found["signals"]]
    np.testing.assert_allclose(values[names.index("tao")], sealed.signals["tao"], rtol=1e-6)
    reasons = [found["reasons"][at] for at in found["reason"]]
    assert reasons == judgement.verdicts["reason"].tolist()
    letter = {"accept": "a", "reject": "r", "abstain": "-"}
    assert found["verdict"] == "".join(letter[v] for v in judgement.verdicts["verdict"])


def test_terms_on_the_page_add_up_to_the_probability(held):
    _, done, found = held
    model, n = found["model"], 240
    values = unpacked(found["values"], "<f4").reshape(-1, n).astype(float)
    terms = [
        (values[c] - m) / s * w
        for c, m, s, w in zip(
            *(model[k] for k in ("columns", "mean", "scale", "weight")), strict=True
        )
    ]
    odds = np.sum(terms, axis=0) + done.judgement.calibration.final.bias
    at = [signal["name"] for signal in found["signals"]].index("probability_wrong")
    lone = [signal["name"] for signal in found["signals"]].index("alone")
    least = np.minimum(1.0, DOUBT_COUNTS * values[lone])
    np.testing.assert_allclose(np.maximum(1 / (1 + np.exp(-odds)), least), values[at], atol=1e-5)


def test_a_long_run_is_thinned_and_says_so(held, monkeypatch):
    sealed, done, _ = held
    monkeypatch.setattr(frame_explorer, "MOST_FRAMES", 100)
    found = json.loads(frame_explorer.route_json(done.judgement, sealed.index, sealed.similarity))
    assert (found["every"], found["frames"], len(found["verdict"])) == (3, 240, 80)
    assert found["verdict"][1] == held[2]["verdict"][3]


def test_fewer_candidates_are_embedded_where_there_is_no_room(held, monkeypatch):
    sealed, done, _ = held
    monkeypatch.setattr(frame_explorer, "_CANDIDATE_BYTES", 16_000)
    found = json.loads(frame_explorer.route_json(done.judgement, sealed.index, sealed.similarity))
    assert found["candidates"]["k"] == 12
    assert found["candidates"]["of"] == 100


def test_text_of_a_run_cannot_end_the_script_that_holds_it(held):
    sealed, done, _ = held
    verdicts = dict(done.judgement.verdicts)
    verdicts["reason"] = np.full(240, "</script><b>", dtype=object)
    judgement = done.judgement._replace(verdicts=verdicts)
    text = frame_explorer.route_json(judgement, sealed.index, sealed.similarity)
    assert "<" not in text
    assert json.loads(text)["reasons"] == ["</script><b>"]


def test_a_run_that_is_never_judged_still_has_a_route(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "draw", lambda judgement: ())
    run, truth = judged.seal(tmp_path, n=60, status="degenerate")
    evaluate(run, truth, judged.config(r_in_m=1e-6, r_out_m=1e-5))
    assert 'id="route-data"' in (run / "report.html").read_text()


def test_marking_keeps_the_text_and_takes_the_longest_word_once():
    words = {"FAR": "short", "FAR at 95 %": "long", "in-map": "inside"}
    text = "FAR at 95 % and FAR, FAR again; AFAR in-mapped in-map."
    pieces = marked(text, words)
    assert "".join(piece.text for piece in pieces) == text
    assert [(p.text, p.title) for p in pieces if p.title] == [
        ("FAR at 95 %", "long"), ("FAR", "short"), ("in-map", "inside"),
    ]  # fmt: skip
    assert [p.text for p in marked(text, {})] == [text]


def test_no_definition_is_empty():
    assert all(len(meaning) > 10 for meaning in glossary().values())
    assert all(len(meaning) > 10 for meaning in names_of_signals().values())


def test_a_page_without_route_words_or_pictures_renders():
    page = Page(
        title="A < B", subtitle="", notes=[], headline=["said"], grids=[], pictures=[],
        facts={}, command="taojax kidnap",
    )  # fmt: skip
    html = render(page)
    assert "A &lt; B" in html
    assert 'id="route-data"' not in html
    assert 'href="#figures"' not in html
