// What a policy read of its memory: a strip of what the chunk at the playhead read, and below it what every chunk read.
// Heat is attention over an equal share of it: 1 where every remembered frame is read alike.

/** The lanes of an episode's reads, none where nobody wrote them down; `show` moves the strip to the chunk at a frame. */
function readLanes(episode, draw, seek) {
  const chunks = episode.reads.map(([step, entries, weights]) => ({ step, cells: cellsOf(entries, weights, step) }));
  if (!chunks.length) return { lanes: [], show() {} };
  const most = Math.max(...chunks.flatMap(({ cells }) => cells.map(({ heat }) => heat)));
  const whose = el("span", { class: "words" });
  const strip = el("span", { class: "strip", role: "group", "aria-label": "Memory read by this chunk" });
  const here = el("span", { class: "here" });
  const words = `Rows are action chunks, the first on top; columns are the frames that they remember.
The hottest cell was read ${most.toFixed(1)} times as much as an equal share.`;
  const lanes = [
    draw.lane("read", whose, strip),
    draw.lane("reads", el("span", { class: "words" }, "Memory read by every chunk"), heatMap(episode, chunks, most, words, draw), here),
  ];
  strip.addEventListener("keydown", walk);

  let shown = null;
  const show = (frame) => {
    const k = chunks.findLastIndex(({ step }) => step <= frame);
    if (k === shown) return;
    shown = k;
    const focused = [...strip.children].indexOf(document.activeElement);
    const cells = k < 0 ? [] : chunks[k].cells.map((cell) => heatCell(episode, cell, most, draw, seek));
    strip.replaceChildren(...cells);
    if (cells.length) reach(cells[Math.min(Math.max(focused, 0), cells.length - 1)], focused >= 0);
    whose.textContent = k < 0 ? "memory read: no chunk is planned yet" : `Memory read by chunk ${k + 1} of ${chunks.length}`;
    here.hidden = k < 0;
    here.style.top = `${(100 * k) / chunks.length}%`;
    here.style.height = `${100 / chunks.length}%`;
  };
  return { lanes, show };
}

/** The cells of a chunk, in frames: a remembered frame's lasts until the next one. Slots, of no frame, lie side by side. */
function cellsOf(entries, weights, step) {
  const all = weights.reduce((sum, weight) => sum + weight, 0) || 1;
  const slots = entries.filter((entry) => entry < 0).length;
  const frames = entries.filter((entry) => entry >= 0);
  return entries.map((entry, k) => {
    const next = entry < 0 ? null : (frames[frames.indexOf(entry) + 1] ?? Math.max(step, entry + 1));
    const [from, to] = entry < 0 ? [(-1 - entry) / slots, -entry / slots] : [entry, next];
    return { entry, from, to, weight: weights[k], heat: (weights[k] / all) * entries.length };
  });
}

/** Where a cell lies on the timeline: frames at their time, slots over its whole length. */
const extent = (episode, { entry, from, to }) => (entry < 0 ? [from * lastFrame(episode), to * lastFrame(episode)] : [from, to]);

function heatCell(episode, cell, most, draw, seek) {
  const [from, to] = extent(episode, cell);
  const { phase, step } = situation(episode, cell.entry);
  const what = cell.entry < 0 ? `memory slot ${-cell.entry}` : `${phase} step ${step}, ${seconds(cell.entry)}`;
  const tip = `${capital(what)}\nread ${(100 * cell.weight).toFixed(1)} %: ${cell.heat.toFixed(1)} × an equal share`;
  const button = el("button", {
    type: "button",
    class: "cell",
    tabindex: "-1",
    style: { left: draw.at(from), width: `calc(${draw.at(to)} - ${draw.at(from)} + 0.5px)`, "--heat": cell.heat / most },
    "data-tip": tip,
    "aria-label": tip.replaceAll("\n", ", "),
    on: { click: () => cell.entry < 0 || seek(cell.entry) },
  });
  if (episode.video && cell.entry >= 0) button.image = () => imageAt(episode, cell.entry);
  return button;
}

/** All chunks as one image, a row each. */
function heatMap(episode, chunks, most, words, draw) {
  const end = lastFrame(episode);
  const map = el("canvas", { width: Math.min(end, 1600), height: chunks.length, role: "img", "aria-label": words, "data-tip": words });
  Object.assign(map.style, { left: draw.at(0), width: `calc(${draw.at(end)} - ${draw.at(0)})` });
  const pen = map.getContext("2d");
  pen.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--hot");
  chunks.forEach(({ cells }, row) => {
    for (const cell of cells) {
      const [from, to] = extent(episode, cell).map((frame) => Math.round((frame * map.width) / end));
      pen.globalAlpha = cell.heat / most;
      pen.fillRect(from, row, Math.max(to - from, 1), 1);
    }
  });
  return map;
}

/** One cell of the strip is reached by Tab, its neighbours by the arrows. */
function reach(cell, focus = true) {
  for (const other of cell.parentElement.children) other.tabIndex = other === cell ? 0 : -1;
  if (focus) cell.focus();
}

function walk(event) {
  const cells = [...event.currentTarget.children];
  const at = cells.indexOf(event.target);
  const to = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: cells.length - 1 }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  event.stopPropagation(); // elsewhere the arrows move the playhead
  if (cells[to]) reach(cells[to]);
}

/** A frame of an episode's video, small: the main camera, which is its lower left. */
function imageAt(episode, frame) {
  if (imageAt.episode !== episode) Object.assign(imageAt, { episode, video: screenOf(episode).video });
  imageAt.video.currentTime = timeOf(frame);
  return el("span", { class: "image" }, imageAt.video);
}
