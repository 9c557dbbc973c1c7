// Elements, shapes and words that every part of the page uses. Text always goes in as text, never as markup.

const byId = (id) => document.getElementById(id);

/** Make an element. `style` sets CSS properties, `on` listeners, the rest attributes; null children fall out. */
function el(name, attributes = {}, ...children) {
  return dress(document.createElement(name), attributes, children);
}

function svg(name, attributes = {}, ...children) {
  return dress(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function dress(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key === "on") for (const [event, listener] of Object.entries(value)) element.addEventListener(event, listener);
    else if (key === "style") for (const [name, it] of Object.entries(value)) element.style.setProperty(name, it);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return element;
}

/** Storage is a circle, Update a square, Compression a diamond: distinguished without colour. */
const OUTLINES = {
  S: () => svg("circle", { cx: 10, cy: 10, r: 8 }),
  U: () => svg("rect", { x: 2.5, y: 2.5, width: 15, height: 15, rx: 2.5 }),
  C: () => svg("polygon", { points: "10,0.8 19.2,10 10,19.2 0.8,10" }),
};

/** The shape of an operation; `fill` is "full", "hollow" or "none" (never satisfied). */
function shape(operation, fill = "full", letter = false) {
  return svg(
    "svg",
    { viewBox: "0 0 20 20", class: `shape op-${operation} ${fill}`, "aria-hidden": "true" },
    OUTLINES[operation](),
    letter ? svg("text", { x: 10, y: 10.4 }, operation) : null,
  );
}

const badge = (operation) =>
  el(
    "span",
    { class: "badge", role: "img", "aria-label": operationName(operation), "data-tip": operationName(operation) },
    shape(operation, "full", true),
  );

const operationName = (operation) => DATA.operations[operation].name;

/** Outcomes: what the log calls them, what people do, and the letter that stands for them where room is short. */
const OUTCOMES = {
  success: { words: "success", letter: "✓", why: "The goal holds at the end." },
  storage_failure: {
    words: "storage failure",
    letter: "S",
    why: "The first checkpoint that never held is a Storage checkpoint.",
  },
  stale_memory: {
    words: "stale memory",
    letter: "U",
    why: "The first checkpoint that never held is an Update checkpoint.",
  },
  compression_collapse: {
    words: "compression collapse",
    letter: "C",
    why: "The first checkpoint that never held is a Compression checkpoint.",
  },
  reference_drift: {
    words: "reference drift",
    letter: "R",
    why: "Another answer than the prompt's took its place: a wrong referent, target or item.",
  },
  execution_failure: {
    words: "execution failure",
    letter: "X",
    why: "Every checkpoint held at some step, the goal did not at the end.",
  },
  wrong_order: { words: "wrong order", letter: "O", why: "Steps or events were done in another order than asked for." },
  cut_off: {
    words: "cut off",
    letter: "H",
    why: "The horizon is shorter than the protocol's: what is missing might have come.",
  },
  miscount: { words: "miscount", letter: "N", why: "The event was done too seldom or too often." },
  wrong_place: { words: "wrong place", letter: "P", why: "The thing was looked for where it is not." },
  hand: { words: "hand", letter: "M", why: "All that had to be remembered was right; the motion failed." },
  invalid_action: { words: "invalid action", letter: "I", why: "An action of another shape, or not finite, ended it." },
  unstable_physics: { words: "unstable physics", letter: "B", why: "The physics broke down and ended it." },
};

if (DATA.suite) {
  // LIBERO's tasks have no checkpoints: other classes do not occur, and this one means no more than this.
  for (const name of Object.keys(OUTCOMES)) if (name !== "success" && !DATA.failures.includes(name)) delete OUTCOMES[name];
  if (OUTCOMES.execution_failure) OUTCOMES.execution_failure.why = "The goal was not reached within the step limit.";
}

const outcomeMark = (outcome) =>
  el(
    "span",
    { class: `outcome is-${outcome}`, role: "img", "aria-label": OUTCOMES[outcome].words },
    OUTCOMES[outcome].letter,
  );

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);
/** A memory type as a title, or the name of a suite of LIBERO. */
const groupName = (group) => (DATA.suite ? group : capital(group));
/** A task's instruction, after LIBERO's id where it has one. */
const taskTitle = (task) => `${DATA.tasks[task].id === null ? "" : `${DATA.tasks[task].id} · `}${capital(DATA.tasks[task].language)}`;
const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
const seconds = (frames) => `${(frames / DATA.fps).toFixed(1)} s`;

/** Per run and task the texts of a checkpoint at a language level; null where the task's files are not known. */
function checkpointTexts(task, variant, index) {
  return DATA.tasks[task].variants[variant]?.checkpoints[index]?.texts ?? null;
}

function checkpointText(task, variant, index, level) {
  return checkpointTexts(task, variant, index)?.[DATA.levels.indexOf(level)] ?? `checkpoint ${index + 1}`;
}

/** One tooltip for everything that has `data-tip`, on hover and on keyboard focus; a `image()` of its owner is above
    the words. */
function enableTips() {
  const tip = byId("tip");
  const show = (event) => {
    const owner = event.target.closest?.("[data-tip]");
    tip.hidden = !owner;
    if (!owner) return;
    tip.replaceChildren(owner.image?.() ?? "", owner.dataset.tip);
    const box = owner.getBoundingClientRect();
    const x = event.type === "focusin" ? box.left + box.width / 2 : event.clientX;
    const left = Math.min(Math.max(8, x - tip.offsetWidth / 2), innerWidth - tip.offsetWidth - 8);
    const above = box.top - tip.offsetHeight - 8;
    tip.style.left = `${left}px`;
    tip.style.top = `${above < 4 ? box.bottom + 8 : above}px`;
  };
  for (const event of ["pointerover", "focusin"]) document.addEventListener(event, show);
  for (const event of ["focusout", "scroll", "pointerleave"])
    document.addEventListener(event, () => (tip.hidden = true), true);
  document.addEventListener("keydown", (event) => event.key === "Escape" && (tip.hidden = true));
}
