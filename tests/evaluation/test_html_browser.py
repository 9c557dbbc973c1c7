"""The HTML report in headless Chromium, by clicks and keys.

The grey of frame k of each video is 16 + 4 · k, so a screenshot shows which frame is displayed.
"""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.evaluation.html import write_html
from lerobot_memobench.policies.memory_reads import reads_file, write_reads
from lerobot_memobench.tasks.catalogue import get_task
from tests.support import browser as chromium
from tests.support.logs import record, write_log

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "check_the_top_drawer_of_the_cabinet"
BUTTER = "put_the_butter_picked_up_in_the_prompt_video_on_the_plate"
SOUP = "pick_up_the_alphabet_soup_and_place_it_in_the_basket"
NASTY = "</script><img src=x onerror=alert(1)><b>"
FPS = 20


pytestmark = pytest.mark.skipif(
    chromium.find_chromium() is None,
    reason="Chromium is missing; `make test` installs it where it may, else: apt-get install chromium",
)


def rollout(task: str, episode: int, marks: list[tuple[str, int | None, int | None]], **changes: Any) -> dict[str, Any]:
    success = changes.get("failure") is None
    own = {"variant": 0, "prompt_steps": 0, "steps": 40, "success": success, "scene_hash": "0123456789abcdef"}
    return record(task, episode, marks, **own | changes)


RECORDS = [
    rollout(STOVE, 0, [("S", 10, 10), ("U", 4, 30)]),
    rollout(STOVE, 1, [("S", None, None), ("U", 25, None)], failure="storage_failure"),
    rollout(STOVE, 2, [("S", 10, 10), ("U", None, None)], failure="stale_memory"),
    rollout(DRAWER, 0, [("S", 40, 40)]),
    rollout(BUTTER, 0, [("S", 20, 20)], memory_type="object", prompt_steps=15, steps=20),
    rollout(BUTTER, 1, [("S", None, None)], memory_type="object", prompt_steps=15, failure="reference_drift"),
    rollout(NASTY, 0, [("C", 40, 40)], memory_type="procedural"),
]


READ: list[Any] = [
    {"step": 15, "entries": [0, 8], "weights": [0.1, 0.3]},  # two thirds of attention are paid to something else
    {"step": 21, "entries": [0, 8, 16], "weights": [0.25, 0.5, 0.25]},
]
SLOTS: list[Any] = [{"step": 0, "entries": [-2, -1], "weights": [0.75, 0.25]}]


def film(path: Path, frames: int) -> None:
    strip = VideoRecorder(path)
    for k in range(frames):
        strip.add(np.full((80, 128, 3), 16 + 4 * k, np.uint8))
    strip.finish()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs: `mine` with films of the first stove and butter rollouts, `other` with one of a shorter stove."""
    root = tmp_path_factory.mktemp("report with spaces & #signs")
    write_log(root / "mine", RECORDS)
    film(root / "mine" / "videos" / f"{STOVE}.0.mp4", 41)
    film(root / "mine" / "videos" / f"{BUTTER}.0.mp4", 36)
    write_reads(reads_file(root / "mine", BUTTER, 0), {"seed": 7, "referent": "fixed", "chunks": [*READ]})
    write_reads(reads_file(root / "mine", STOVE, 2), {"seed": 9, "referent": "fixed", "chunks": [*SLOTS]})
    write_log(
        root / "other",
        [
            rollout(STOVE, 0, [("S", None, None), ("U", None, None)], failure="storage_failure", steps=25),
            rollout(BUTTER, 1, [("S", 9, 9)], memory_type="object", prompt_steps=15),
        ],
    )
    film(root / "other" / "videos" / f"{STOVE}.0.mp4", 26)
    written = write_html([root / "mine", root / "other"], root / "made")
    assert written.videos == 3
    (root / "made").rename(root / "moved")  # the page must not depend on its place
    return root / "moved" / "index.html"


@pytest.fixture(scope="module")
def chrome(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    browser = chromium.Browser(tmp_path_factory.mktemp("chromium") / "profile")
    yield browser
    browser.close()


@pytest.fixture
def browser(chrome: Any) -> Iterator[Any]:
    """The browser; the page must log no error and request only the report's own files."""
    chrome.resize(1280, 900)
    chrome.colours("light")
    yield chrome
    assert chrome.errors == []
    strangers = [address for address in chrome.requests if not address.startswith(("file://", "data:"))]
    assert strangers == []


def show(browser: Any, report: Path, address: str = "") -> None:
    browser.open(f"{report.as_uri()}#{address}")


def shown_frame(browser: Any, video: str) -> int:
    """Return the number of the displayed frame, from its grey."""
    from PIL import Image

    box = browser.box(video)
    image = Image.open(browser.screenshot(Path(browser._log.name).with_suffix(".png")))
    grey = image.convert("L").getpixel((int(box["x"] + box["width"] / 2), int(box["y"] + box["height"] / 2)))
    return round((grey - 16) / 4)


def assert_shown(browser: Any, frame: int, video: str = "video") -> None:
    """Wait for a frame on the screen: without a graphics card it is drawn some time after the seek."""
    deadline = time.monotonic() + chromium.PATIENCE
    while (shown := shown_frame(browser, video)) != frame and time.monotonic() < deadline:
        time.sleep(0.1)
    assert shown == frame


def settle(browser: Any) -> None:
    """Wait until every video has sought its frame, and for two frames of the browser."""
    browser.wait("[...document.querySelectorAll('video')].every((video) => !video.seeking)")
    browser.js("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def playhead(browser: Any) -> int:
    return int(browser.js("document.querySelector('[role=slider]').getAttribute('aria-valuenow')"))


def ready(browser: Any) -> None:
    browser.wait("document.querySelector('video')?.readyState >= 2")
    browser.wait("[...document.querySelectorAll('video')].every((video) => video.readyState >= 2)")


PAIR = f"view=compare&ep={STOVE}.0"
LEFT, RIGHT = (f".pair > section:nth-child({k}) video" for k in (1, 2))
VIEWS = ("", f"view=episodes&ep={STOVE}.0", f"view=episodes&ep={STOVE}.1", PAIR)


def test_overview(browser: Any, report: Path) -> None:
    show(browser, report)
    rows = [" ".join(row.split()) for row in browser.texts(".columns table.rates tbody tr")]
    assert rows[0].startswith("Average mine 7")
    assert any(row.startswith("Temporal mine 4 66.7") for row in rows)  # the mean of 1 of 3 and 1 of 1, not 2 of 4
    assert browser.texts("#overview .key li")[:2] == ["✓\nsuccess\n4", "S\nstorage failure\n1"]
    chips = browser.texts(".tasks tbody tr:nth-child(2) .chip")
    assert [chip.split()[-1] for chip in chips] == ["67", "33"]
    links = browser.js("[...document.querySelectorAll('a.csv')].map((a) => [a.download, a.href])")
    assert [name for name, _ in links] == [
        *("mine-memory-types.csv", "mine-failures.csv", "mine-tasks.csv", "mine-prefix.csv")
    ]
    saved = unquote(dict(links)["mine-tasks.csv"].partition(",")[2])
    rates = {row["task"]: row for row in csv.DictReader(io.StringIO(saved))}
    assert (rates[STOVE]["SR"], rates[NASTY]["MCR"]) == ("33.3", "100.0")
    browser.click(".endings .part.is-stale_memory")
    browser.wait("!document.querySelector('#episodes').hidden")
    assert browser.texts("#count") == ["1 of 7 episodes, 0 succeeded"]
    assert "outcome=stale_memory" in browser.js("location.hash")
    browser.js("history.back()")
    browser.wait("!document.querySelector('#overview').hidden")


def test_names_are_text(browser: Any, report: Path) -> None:
    show(browser, report, "view=episodes&type=procedural")
    assert browser.texts("#detail h2") == [NASTY.replace("_", " ")]
    assert browser.js("document.querySelectorAll('img, #detail b b').length") == 0


# --- video and timeline ---


def test_timeline_seeks_the_video(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={STOVE}.0")
    ready(browser)
    for frame in (23, 40):
        browser.click(".timeline .axis", across=min(frame / 40, 0.999))
        settle(browser)
        assert playhead(browser) == frame
        assert browser.js("document.querySelector('video').currentTime") == pytest.approx((frame + 0.5) / FPS)
        assert_shown(browser, frame)
    fills = "[...document.querySelectorAll('.lane.checkpoint .mark')].map((m) => [Number(m.dataset.frame), "
    fills += "m.querySelector('.shape').classList.contains('full')])"
    assert browser.js(fills) == [[10, True], [4, False], [30, True]]
    browser.click('.mark[data-frame="4"]')
    settle(browser)
    assert_shown(browser, 4)
    first, second = (checkpoint.language for checkpoint in get_task(STOVE).checkpoints)
    for frame, expected in ((9, first[1]), (10, second[1]), (40, "done")):
        browser.click(".timeline .axis", across=min(frame / 40, 0.999))
        assert expected in browser.texts("p.now")[0].split("\n")[-1]
    browser.choose("#level", "fine")
    browser.wait(f"document.querySelector('.lane.checkpoint .words').textContent === {json.dumps(first[2])}")
    assert browser.js("location.hash.includes('level=fine')")


def test_prompt_failure_and_memory_reads(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={BUTTER}.0")
    ready(browser)
    widths = browser.js("[...document.querySelectorAll('.phases .span')].map((s) => s.style.width)")
    assert [float(width.rstrip("%")) for width in widths] == pytest.approx([100 * 15 / 35, 100 * 20 / 35])
    assert browser.texts("p.now") == ["watch the prompt"]
    alpha = "((x, y) => document.querySelector('canvas').getContext('2d').getImageData(x, y, 1, 1).data[3] / 255)"
    seen = [[browser.js(f"{alpha}({x}, {y})") for x in (4, 12, 18)] for y in (0, 1)]
    assert seen[0] == pytest.approx([1 / 3, 1, 0], abs=0.01)
    assert seen[1] == pytest.approx([0.5, 1, 0.5], abs=0.01)
    tips = "[...document.querySelectorAll('.cell')].map((cell) => cell.dataset.tip.split('\\n'))"
    browser.click(".timeline .axis", across=17 / 35)
    assert browser.js(tips) == [
        ["Prompt step 0, 0.0 s", "read 10.0 %: 0.5 × an equal share"],
        ["Prompt step 8, 0.4 s", "read 30.0 %: 1.5 × an equal share"],
    ]
    browser.click(".timeline .axis", across=21 / 35)
    assert browser.js(tips)[2] == ["Execution step 1, 0.8 s", "read 25.0 %: 0.8 × an equal share"]
    browser.js("document.querySelector('.cell[tabindex=\"0\"]').focus()")
    browser.key("ArrowRight")
    assert browser.texts("#tip")[0].startswith("Prompt step 8")
    browser.wait("document.querySelector('#tip video')?.readyState >= 2")
    settle(browser)
    assert_shown(browser, 8, "#tip .image")
    browser.click(".cell:nth-child(2)")
    assert playhead(browser) == 8
    show(browser, report, f"view=episodes&ep={BUTTER}.1")
    tip = browser.js("document.querySelector('.cause.is-reference_drift').dataset.tip")
    assert "never held: reference drift" in tip
    show(browser, report, f"view=episodes&ep={STOVE}.2")
    cells = "[...document.querySelectorAll('.cell')].map((cell) => [cell.dataset.tip.split('\\n')[0], cell.style.left])"
    assert browser.js(cells) == [["Memory slot 2", "50%"], ["Memory slot 1", "0%"]]


def test_missing_videos_are_named(chrome: Any, report: Path, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(report.read_text())
    show(chrome, tmp_path / "index.html", f"view=episodes&ep={STOVE}.0")
    chrome.wait("!document.querySelector('.stage .notice').hidden")
    assert "ERR_FILE_NOT_FOUND" in "".join(chrome.errors)
    chrome.errors.clear()


# --- finding ---


def test_filters_and_search(browser: Any, report: Path) -> None:
    for view, filters, count in (
        ("episodes", {"#type": "object", "#outcome": "failed"}, "1 of 7"),
        ("episodes", {"#task": STOVE, "#op": "missed-U"}, "1 of 7"),
        ("episodes", {"#outcome": "no-video"}, "5 of 7"),
        ("episodes", {"#q": "SEED 8"}, "2 of 7"),
        ("episodes", {"#q": "zebra"}, "0 of 7"),
        ("compare", {"#outcome": "second", "#type": "object"}, "1 of 2 pairs"),
        ("compare", {"#outcome": "neither"}, "0 of 2 pairs"),
        ("compare", {"#op": "missed-U"}, "1 of 2 pairs"),
    ):
        show(browser, report, f"view={view}")
        for selector, value in filters.items():
            (browser.write if selector == "#q" else browser.choose)(selector, value)
        browser.wait(f"document.querySelector('#count').innerText.startsWith('{count}')")
        found = int(count.split()[0])
        assert len(browser.texts("#list .row")) == found
        if not found:
            assert browser.texts("#detail") == ["No episode is selected."]
        address = browser.js("location.hash")
        show(browser, report, address[1:])
        browser.wait(f"document.querySelector('#count').innerText.startsWith('{count}')")


def test_keys(browser: Any, report: Path) -> None:
    show(browser, report, "view=episodes")
    order = browser.js("[...document.querySelectorAll('.row')].map((row) => row.dataset.id)")
    assert order[:2] == [f"{DRAWER}.0", f"{STOVE}.0"]
    for key, place in (("j", 1), ("j", 2), ("k", 1)):
        browser.key(key)
        browser.wait(f"document.querySelector('.row[aria-current]').dataset.id === '{order[place]}'")
    ready(browser)
    browser.key("ArrowRight")
    browser.key("ArrowRight", modifiers=8)
    assert playhead(browser) == 21
    browser.key("[")
    assert playhead(browser) == 10
    browser.key("]")
    assert playhead(browser) == 30
    browser.key("/")
    assert browser.js("document.activeElement.id") == "q"
    browser.js("document.activeElement.blur()")
    browser.key("o")
    browser.wait("!document.querySelector('#overview').hidden")
    browser.key("?")
    browser.wait("document.querySelector('dialog').open")
    browser.key("Escape")
    browser.wait("!document.querySelector('dialog').open")


def test_long_lists_are_filled_on_demand(browser: Any, tmp_path: Path) -> None:
    records = [rollout(STOVE, k, [("S", 10, 10), ("U", 30, 30)]) for k in range(1500)]
    write_log(tmp_path / "run", records)
    write_html([tmp_path / "run"], tmp_path / "out")
    page = tmp_path / "out" / "index.html"
    show(browser, page, "view=episodes")
    rows = "document.querySelectorAll('#list .row').length"
    before = browser.js(rows)
    assert before < 200
    browser.js("document.querySelector('#list').scrollTo(0, 1e9)")
    browser.wait(f"{rows} > {before}")
    show(browser, page, f"view=episodes&ep={STOVE}.1499")
    assert browser.js("document.querySelector('.row[aria-current]').dataset.id") == f"{STOVE}.1499"
    box = browser.js("document.querySelector('.row[aria-current]').getBoundingClientRect().toJSON()")
    assert 0 < box["top"] < 900


def test_one_control_moves_both_videos(browser: Any, report: Path) -> None:
    """The shorter rollout stays on its last frame."""
    show(browser, report, PAIR)
    ready(browser)
    assert browser.js("[...document.querySelectorAll('.phases .mark')].map((m) => m.style.left)") == ["100%", "62.5%"]
    for at, both in ((23, (23, 23)), (36, (36, 25))):
        browser.js(
            f"(() => {{ const e = document.querySelector('.both input'); e.value = {at}; "
            "e.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )
        settle(browser)
        for video, frame in zip((LEFT, RIGHT), both, strict=True):
            assert_shown(browser, frame, video)
    browser.click(".pair > section:nth-child(2) .axis", across=12 / 40)
    settle(browser)
    assert_shown(browser, 12, LEFT)
    browser.key("Home")
    for _ in range(4):
        browser.key("]")
    settle(browser)
    times = browser.js("[...document.querySelectorAll('video')].map((v) => v.currentTime)")
    assert [int(time * FPS) for time in times] == [30, 25], "marks of both, the end of the shorter one among them"


# --- accessibility and security ---


def test_controls_have_names(browser: Any, report: Path) -> None:
    for address in VIEWS:
        show(browser, report, address)
        nodes = browser.call("Accessibility.getFullAXTree")["nodes"]
        used = [
            (node["role"]["value"], node.get("name", {}).get("value", ""))
            for node in nodes
            if node.get("role", {}).get("value")
            in ("button", "link", "combobox", "searchbox", "slider", "image", "Video")
        ]
        assert len(used) > 10
        assert [role for role, name in used if not name.strip()] == []


def test_a_narrow_screen_needs_no_sideways_scrolling(browser: Any, report: Path) -> None:
    browser.resize(360, 740)
    for address in VIEWS:
        show(browser, report, address)
        assert browser.js("document.documentElement.scrollWidth") <= 360


def test_the_page_cannot_reach_the_network(chrome: Any, report: Path) -> None:
    show(chrome, report)
    blocked = chrome.js(
        "new Promise((done) => { document.addEventListener('securitypolicyviolation', (e) => "
        "done(e.effectiveDirective)); fetch('https://example.invalid/').catch(() => {}); })"
    )
    assert blocked == "connect-src"
    chrome.errors.clear()


# --- LIBERO's suites ---


def test_a_suite_of_libero_shows_success_alone(browser: Any, tmp_path: Path) -> None:
    own = {"memory_type": "libero_object", "suite": "libero_object", "convention": "libero"}
    write_log(tmp_path / "run", [rollout(SOUP, 0, [], **own), rollout(SOUP, 1, [], **own, failure="execution_failure")])
    write_html([tmp_path / "run"], tmp_path / "made")
    show(browser, tmp_path / "made" / "index.html")
    heads = browser.js("[...document.querySelectorAll('#overview table.rates')].map((it) => it.tHead.innerText)")
    assert [" ".join(words.split()) for words in heads] == ["Suite n SR", "libero_object · 1 task n SR Outcomes"]
    shown = browser.js("document.querySelector('#overview').innerText")
    assert "50.0" in shown
    assert not {word for word in ("MSR", "Average", "Checkpoints", "undefined") if word in shown}
    assert "0 · Pick up the alphabet soup" in shown
