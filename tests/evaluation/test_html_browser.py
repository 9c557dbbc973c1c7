"""The HTML report in headless Chromium: what a person does with it, by real clicks and keys.

The videos are made so that every frame says its number: its grey is 16 + 4 · k. A screenshot then tells which frame the
browser really shows.
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

from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.evaluation.html.write import write_html
from lerobot_memobench.policies.memory_reads import reads_file, write_reads
from lerobot_memobench.tasks.catalogue import get_task
from tests.support import browser as chromium
from tests.support.logs import record

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "check_the_top_drawer_of_the_cabinet"
BUTTER = "put_the_butter_picked_up_in_the_prompt_video_on_the_plate"
NASTY = "</script><img src=x onerror=alert(1)><b>"
FPS = 20


pytestmark = pytest.mark.skipif(
    chromium.find_chromium() is None,
    reason="no Chromium is here; `make test` installs it where it may, else ask for: apt-get install chromium",
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
    write_episodes(root / "mine", RECORDS)
    film(root / "mine" / "videos" / f"{STOVE}.0.mp4", 41)
    film(root / "mine" / "videos" / f"{BUTTER}.0.mp4", 36)
    write_reads(reads_file(root / "mine", BUTTER, 0), {"seed": 7, "referent": "fixed", "chunks": [*READ]})
    write_reads(reads_file(root / "mine", STOVE, 2), {"seed": 9, "referent": "fixed", "chunks": [*SLOTS]})
    write_episodes(
        root / "other",
        [
            rollout(STOVE, 0, [("S", None, None), ("U", None, None)], failure="storage_failure", steps=25),
            rollout(BUTTER, 1, [("S", 9, 9)], memory_type="object", prompt_steps=15),
        ],
    )
    film(root / "other" / "videos" / f"{STOVE}.0.mp4", 26)
    written = write_html([root / "mine", root / "other"], root / "made")
    assert written.videos == 3
    (root / "made").rename(root / "moved")  # nothing in it may depend on where it was made
    return root / "moved" / "index.html"


@pytest.fixture(scope="module")
def chrome(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    browser = chromium.Browser(tmp_path_factory.mktemp("chromium") / "profile")
    yield browser
    browser.close()


@pytest.fixture
def browser(chrome: Any) -> Iterator[Any]:
    """The browser, which must have nothing to complain about and have asked for nothing but the report's own files."""
    chrome.resize(1280, 900)
    chrome.colours("light")
    yield chrome
    assert chrome.errors == []
    strangers = [address for address in chrome.requests if not address.startswith(("file://", "data:"))]
    assert strangers == []


def show(browser: Any, report: Path, address: str = "") -> None:
    browser.open(f"{report.as_uri()}#{address}")


def filter_list(browser: Any, report: Path, view: str, filters: dict[str, str], count: str) -> None:
    """Open a view, choose filters, and wait for what it says it has counted."""
    show(browser, report, f"view={view}")
    for selector, value in filters.items():
        browser.choose(selector, value)
    browser.wait(f"document.querySelector('#count').innerText.startsWith('{count}')")


def shown_frame(browser: Any, video: str) -> int:
    """The number of the frame on the screen, read off its grey."""
    from PIL import Image

    box = browser.box(video)
    picture = Image.open(browser.screenshot(Path(browser._log.name).with_suffix(".png")))
    grey = picture.convert("L").getpixel((int(box["x"] + box["width"] / 2), int(box["y"] + box["height"] / 2)))
    return round((grey - 16) / 4)


def assert_shown(browser: Any, frame: int, video: str = "video") -> None:
    """Wait for a frame on the screen: without a graphics card it is drawn some time after the video has sought it."""
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


def place(frame: int, end: int = 40) -> float:
    return frame / end


# --- overview ---


def test_the_overview_shows_rates_outcomes_and_tasks(browser: Any, report: Path) -> None:
    show(browser, report)
    rows = [" ".join(row.split()) for row in browser.texts(".columns table.rates tbody tr")]
    assert rows[0].startswith("Average mine 7")
    assert any(row.startswith("Temporal mine 4 66.7") for row in rows)  # the mean of 1 of 3 and 1 of 1, not 2 of 4
    (first,) = browser.texts("#overview h2")
    assert first.startswith("mine: policy not recorded: published suite, referent fixed, seeds 7 to 9, ")
    assert first.endswith("; inputs: not recorded")
    assert browser.texts("#overview .key li")[:2] == ["✓\nsuccess\n4", "S\nstorage failure\n1"]
    chips = browser.texts(".tasks tbody tr:nth-child(2) .chip")
    assert [chip.split()[-1] for chip in chips] == ["67", "33"]


def test_a_part_of_a_bar_leads_to_its_rollouts(browser: Any, report: Path) -> None:
    show(browser, report)
    browser.click(".endings .part.is-stale_memory")
    browser.wait("!document.querySelector('#episodes').hidden")
    assert browser.texts("#count") == ["1 of 7 episodes, 0 succeeded"]
    assert "outcome=stale_memory" in browser.js("location.hash")
    browser.js("history.back()")
    browser.wait("!document.querySelector('#overview').hidden")


def test_names_are_shown_and_not_run(browser: Any, report: Path) -> None:
    show(browser, report, "view=episodes&type=procedural")
    assert browser.texts("#detail h2") == [NASTY.replace("_", " ")]
    assert browser.js("document.querySelectorAll('img, #detail b b').length") == 0


# --- video and timeline ---


def test_a_click_on_the_timeline_seeks_the_video(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={STOVE}.0")
    ready(browser)
    assert playhead(browser) == 0
    for frame in (23, 7, 40):
        browser.click(".timeline .axis", across=min(place(frame), 0.999))
        settle(browser)
        assert playhead(browser) == frame
        assert browser.js("document.querySelector('video').currentTime") == pytest.approx((frame + 0.5) / FPS)
        assert_shown(browser, frame)


def test_the_playhead_moves_with_the_video(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={STOVE}.0")
    ready(browser)
    browser.click(".play")
    browser.wait("Number(document.querySelector('[role=slider]').getAttribute('aria-valuenow')) > 3")
    browser.click(".play")
    browser.wait("document.querySelector('video').paused")
    time = browser.js("document.querySelector('video').currentTime")
    assert abs(playhead(browser) - time * FPS) <= 2
    at = browser.js("getComputedStyle(document.querySelector('.timeline')).getPropertyValue('--at')")
    assert float(at.rstrip("%")) == pytest.approx(100 * playhead(browser) / 40)


def test_marks_show_first_and_ordered_steps(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={STOVE}.0")
    ready(browser)
    fills = "[...document.querySelectorAll('.lane.checkpoint .mark')].map((m) => [Number(m.dataset.frame), "
    fills += "m.querySelector('.shape').classList.contains('full')])"
    assert browser.js(fills) == [[10, True], [4, False], [30, True]]
    browser.click('.mark[data-frame="4"]')
    settle(browser)
    assert playhead(browser) == 4
    assert_shown(browser, 4)


def test_the_subgoal_changes_at_each_ordered_step(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={STOVE}.0")
    ready(browser)
    first, second = (checkpoint.language for checkpoint in get_task(STOVE).checkpoints)
    seen = {}
    for frame in (9, 10, 40):
        browser.js("document.querySelector('[role=slider]').focus()")
        browser.key("Home")
        for _ in range(frame // 20):
            browser.key("PageDown")
        for _ in range(frame % 20):
            browser.key("ArrowRight")
        assert playhead(browser) == frame
        seen[frame] = browser.texts("p.now")[0].split("\n")[-1]
    assert first[1] in seen[9]
    assert second[1] in seen[10]
    assert seen[40].endswith("done")
    browser.choose("#level", "fine")
    browser.wait(f"document.querySelector('.lane.checkpoint .words').textContent === {json.dumps(first[2])}")
    assert browser.js("location.hash.includes('level=fine')")
    browser.js("document.querySelector('[role=slider]').focus()")
    browser.key("Home")
    assert playhead(browser) == 0
    assert browser.texts("p.now")[0].endswith(first[2])


def test_prompt_and_failure_are_on_the_timeline(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={BUTTER}.0")
    ready(browser)
    widths = browser.js("[...document.querySelectorAll('.phases .span')].map((s) => s.style.width)")
    assert [float(width.rstrip("%")) for width in widths] == pytest.approx([100 * 15 / 35, 100 * 20 / 35])
    assert browser.texts("p.now") == ["watch the prompt"]
    browser.click(".timeline .axis", across=15 / 35)
    settle(browser)
    assert_shown(browser, 15)
    assert browser.texts("p.now")[0].endswith(get_task(BUTTER).checkpoints[0].language[1])
    show(browser, report, f"view=episodes&ep={BUTTER}.1")
    assert "never held: reference drift" in browser.js(
        "document.querySelector('.cause.is-reference_drift').dataset.tip"
    )


def test_what_a_chunk_read_is_under_the_timeline_with_its_frames(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={BUTTER}.0")
    ready(browser)
    assert browser.texts(".lane.read .words") == ["Memory read: no chunk is planned yet"]
    tips = "[...document.querySelectorAll('.cell')].map((cell) => cell.dataset.tip.split('\\n'))"
    browser.click(".timeline .axis", across=17 / 35)
    assert browser.js(tips) == [
        ["Prompt step 0, 0.0 s", "read 10.0 %: 0.5 × an equal share"],
        ["Prompt step 8, 0.4 s", "read 30.0 %: 1.5 × an equal share"],
    ]
    heat = "[...document.querySelectorAll('.cell')].map((cell) => Number(cell.style.getPropertyValue('--heat')))"
    assert browser.js(heat) == pytest.approx([1 / 3, 1])
    browser.click(".timeline .axis", across=21 / 35)
    assert browser.texts(".lane.read .words") == ["Memory read by chunk 2 of 2"]
    assert browser.js(tips)[2] == ["Execution step 1, 0.8 s", "read 25.0 %: 0.8 × an equal share"]
    # The arrows walk through the frames, and the playhead stays; the frame itself is in the tip.
    browser.js("document.querySelector('.cell[tabindex=\"0\"]').focus()")
    browser.key("ArrowRight")
    assert browser.texts("#tip")[0].startswith("Prompt step 8")
    assert playhead(browser) == 21
    browser.wait("document.querySelector('#tip video')?.readyState >= 2")
    settle(browser)
    assert_shown(browser, 8, "#tip .picture")
    browser.key("End")
    settle(browser)
    assert_shown(browser, 16, "#tip .picture")
    browser.click(".cell:nth-child(2)")
    assert playhead(browser) == 8
    assert browser.texts("#tip, .lane.read .words")[0].startswith("Memory read: no chunk")


def test_every_chunk_is_a_row_of_the_map(browser: Any, report: Path) -> None:
    show(browser, report, f"view=episodes&ep={BUTTER}.0")
    alpha = "((x, y) => document.querySelector('canvas').getContext('2d').getImageData(x, y, 1, 1).data[3] / 255)"
    seen = [[browser.js(f"{alpha}({x}, {y})") for x in (4, 12, 18)] for y in (0, 1)]
    assert seen[0] == pytest.approx([1 / 3, 1, 0], abs=0.01)  # the first chunk knew nothing of what came later
    assert seen[1] == pytest.approx([0.5, 1, 0.5], abs=0.01)
    show(browser, report, f"view=episodes&ep={STOVE}.2")
    cells = "[...document.querySelectorAll('.cell')].map((cell) => [cell.dataset.tip.split('\\n')[0], cell.style.left])"
    assert browser.js(cells) == [["Memory slot 2", "50%"], ["Memory slot 1", "0%"]]
    show(browser, report, f"view=episodes&ep={STOVE}.0")
    assert browser.js("document.querySelectorAll('.lane.read, .lane.reads').length") == 0


def test_a_video_that_is_gone_is_named(chrome: Any, report: Path, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(report.read_text())
    show(chrome, tmp_path / "index.html", f"view=episodes&ep={STOVE}.0")
    chrome.wait("!document.querySelector('.stage .notice').hidden")
    assert "cannot play" in chrome.texts(".stage .notice")[0]
    assert "ERR_FILE_NOT_FOUND" in "".join(chrome.errors)
    chrome.errors.clear()


# --- finding ---


@pytest.mark.parametrize(
    ("filters", "found"),
    [
        ({"#type": "object", "#outcome": "failed"}, 1),
        ({"#task": STOVE, "#op": "missed-U"}, 1),
        ({"#outcome": "no-video"}, 5),
        ({"#type": "object", "#op": "U"}, 0),
    ],
)
def test_filters(browser: Any, report: Path, filters: dict[str, str], found: int) -> None:
    filter_list(browser, report, "episodes", filters, f"{found} of 7")
    assert len(browser.texts("#list .row")) == found
    address = browser.js("location.hash")
    show(browser, report, address[1:])
    assert browser.js("location.hash") == address
    assert len(browser.texts("#list .row")) == found
    assert all(browser.js(f"document.querySelector('{s}').value") == value for s, value in filters.items())
    browser.click("#clear")
    browser.wait("document.querySelector('#count').innerText.startsWith('7 of 7')")


@pytest.mark.parametrize(("words", "found"), [("SEED 8", 2), ("butter drift", 1), ("zebra", 0)])
def test_search(browser: Any, report: Path, words: str, found: int) -> None:
    show(browser, report, "view=episodes")
    browser.key("/")
    assert browser.js("document.activeElement.id") == "q"
    browser.write("#q", words)
    browser.wait(f"document.querySelector('#count').innerText.startsWith('{found} of 7')")
    if not found:
        assert browser.texts("#detail") == ["No episode is selected."]


def test_keys_go_through_the_episodes(browser: Any, report: Path) -> None:
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
    browser.key(" ")
    browser.wait("!document.querySelector('video').paused")
    browser.key("o")
    browser.wait("!document.querySelector('#overview').hidden")
    browser.key("?")
    assert browser.js("document.querySelector('dialog').open")
    browser.key("Escape")
    browser.wait("!document.querySelector('dialog').open")


def test_1500_episodes_are_added_to_the_list_as_they_are_needed(browser: Any, tmp_path: Path) -> None:
    records = [rollout(STOVE, k, [("S", 10, 10), ("U", 30, 30)]) for k in range(1500)]
    write_episodes(tmp_path / "run", records)
    write_html([tmp_path / "run"], tmp_path / "out")
    page = tmp_path / "out" / "index.html"
    show(browser, page, "view=episodes")
    assert browser.texts("#count") == ["1500 of 1500 episodes, 1500 succeeded"]
    rows = "document.querySelectorAll('#list .row').length"
    before = browser.js(rows)
    assert before < 200
    browser.js("document.querySelector('#list').scrollTo(0, 1e9)")
    browser.wait(f"{rows} > {before}")
    show(browser, page, f"view=episodes&ep={STOVE}.1499")
    assert browser.js("document.querySelector('.row[aria-current]').dataset.id") == f"{STOVE}.1499"
    box = browser.js("document.querySelector('.row[aria-current]').getBoundingClientRect().toJSON()")
    assert 0 < box["top"] < 900


# --- side by side ---

PAIR = f"view=compare&ep={STOVE}.0"
LEFT, RIGHT = (f".pair > section:nth-child({k}) video" for k in (1, 2))


def frames(browser: Any) -> list[int]:
    """The frames of both videos, by their own times."""
    return [int(time * FPS) for time in browser.js("[...document.querySelectorAll('video')].map((v) => v.currentTime)")]


def test_one_control_moves_both_videos(browser: Any, report: Path) -> None:
    """The shorter rollout rests on its last frame."""
    show(browser, report, PAIR)
    ready(browser)
    for at, both in ((23, (23, 23)), (7, (7, 7)), (36, (36, 25))):
        browser.js(
            f"(() => {{ const e = document.querySelector('.both input'); e.value = {at}; "
            "e.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )
        settle(browser)
        for video, frame in zip((LEFT, RIGHT), both, strict=True):
            assert_shown(browser, frame, video)
        assert [int(n) for n in browser.js(PLAYHEADS)] == list(both)


PLAYHEADS = "[...document.querySelectorAll('.timeline [role=slider]')].map((s) => s.getAttribute('aria-valuenow'))"


def test_both_timelines_have_one_scale_and_seek_both(browser: Any, report: Path) -> None:
    show(browser, report, PAIR)
    ready(browser)
    ends = browser.js("[...document.querySelectorAll('.phases .mark')].map((m) => m.style.left)")
    assert ends == ["100%", "62.5%"]
    browser.click(".pair > section:nth-child(2) .axis", across=place(12))
    settle(browser)
    assert_shown(browser, 12, LEFT)
    assert_shown(browser, 12, RIGHT)
    browser.click(".both input", across=0.2)
    at = int(browser.js("document.querySelector('.both input').value"))
    browser.key("ArrowRight")
    browser.key(" ")  # keys work while the control has the focus
    browser.wait("!document.querySelector('video').paused")
    browser.key(" ")
    assert int(browser.js("document.querySelector('.both input').value")) > at
    browser.key("Home")
    settle(browser)
    assert frames(browser) == [0, 0]
    for _ in range(2):
        browser.key("]")
    browser.key("]")
    settle(browser)
    assert frames(browser) == [25, 25]  # the end of the shorter one is a mark too
    browser.key("]")
    settle(browser)
    assert frames(browser) == [30, 25]


@pytest.mark.parametrize(
    ("filters", "found"),
    [
        ({"#outcome": "differs"}, 2),
        ({"#outcome": "second", "#type": "object"}, 1),
        ({"#outcome": "neither"}, 0),
        ({"#op": "missed-U"}, 1),
    ],
)
def test_pairs_are_filtered(browser: Any, report: Path, filters: dict[str, str], found: int) -> None:
    filter_list(browser, report, "compare", filters, f"{found} of 2 pairs")
    assert len(browser.texts("#list .row")) == found
    if not found:
        assert browser.texts("#detail") == ["No episode is selected."]


# --- tables to take along ---


def test_tables_are_saved_as_csv(browser: Any, report: Path) -> None:
    show(browser, report)
    links = browser.js("[...document.querySelectorAll('a.csv')].map((a) => [a.download, a.href])")
    assert [name for name, _ in links] == [
        *("mine-memory-types.csv", "mine-failures.csv", "mine-tasks.csv", "mine-prefix.csv"),
    ]
    rows = {
        row["task"]: row
        for row in csv.DictReader(io.StringIO(unquote(dict(links)["mine-tasks.csv"].partition(",")[2])))
    }
    assert rows[STOVE]["SR"] == "33.3"
    assert rows[NASTY]["MCR"] == "100.0"


# --- for everybody ---


@pytest.mark.parametrize("address", ["", f"view=episodes&ep={STOVE}.0", f"view=episodes&ep={STOVE}.1", PAIR])
def test_whatever_can_be_used_has_a_name(browser: Any, report: Path, address: str) -> None:
    show(browser, report, address)
    nodes = browser.call("Accessibility.getFullAXTree")["nodes"]
    used = [
        (node["role"]["value"], node.get("name", {}).get("value", ""))
        for node in nodes
        if node.get("role", {}).get("value") in ("button", "link", "combobox", "searchbox", "slider", "image", "Video")
    ]
    assert len(used) > 10
    assert [role for role, name in used if not name.strip()] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("address", ["", f"view=episodes&ep={STOVE}.1", PAIR])
def test_text_stands_out_from_its_ground(browser: Any, report: Path, scheme: str, address: str) -> None:
    """WCAG AA: contrast of 4.5 for every text, computed from the colours the browser paints."""
    browser.colours(scheme)
    show(browser, report, address)
    weak = browser.js(CONTRAST)
    assert weak == []
    dark = browser.js("getComputedStyle(document.documentElement).backgroundColor")
    browser.click("#theme")
    assert browser.js("getComputedStyle(document.documentElement).backgroundColor") != dark
    browser.js("localStorage.clear()")


CONTRAST = """
(() => {
  const canvas = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
  const rgba = (colour) => {
    canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
    return [...canvas.getImageData(0, 0, 1, 1).data];
  };
  const over = ([r, g, b, a], ground) => [r, g, b].map((v, k) => v * a / 255 + ground[k] * (1 - a / 255));
  const ground = (e) => {
    const colour = rgba(getComputedStyle(e).backgroundColor);
    return colour[3] === 255 || !e.parentElement ? colour.slice(0, 3) : over(colour, ground(e.parentElement));
  };
  const light = (rgb) => rgb.map((v) => v / 255).map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const weak = new Set();
  for (const e of document.querySelectorAll("body *")) {
    const text = [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim());
    const apart = e.closest("svg, script, style, option, .ending, .skip, .visually-hidden");
    if (!text || apart || !e.checkVisibility()) continue;
    const back = ground(e), front = over(rgba(getComputedStyle(e).color), back);
    const [a, b] = [light(back), light(front)].sort((x, y) => y - x);
    if ((a + 0.05) / (b + 0.05) < 4.5) weak.add(`${e.tagName}.${e.className} ${((a + 0.05) / (b + 0.05)).toFixed(2)}`);
  }
  return [...weak];
})()
"""


@pytest.mark.parametrize("address", ["", f"view=episodes&ep={STOVE}.0", PAIR])
def test_a_telephone_needs_no_sideways_scrolling(browser: Any, report: Path, address: str) -> None:
    browser.resize(360, 740)
    show(browser, report, address)
    assert browser.js("document.documentElement.scrollWidth") <= 360


def test_the_page_may_not_reach_the_network(chrome: Any, report: Path) -> None:
    show(chrome, report)
    blocked = chrome.js(
        "new Promise((done) => { document.addEventListener('securitypolicyviolation', (e) => "
        "done(e.effectiveDirective)); fetch('https://example.invalid/').catch(() => {}); })"
    )
    assert blocked == "connect-src"
    chrome.errors.clear()
