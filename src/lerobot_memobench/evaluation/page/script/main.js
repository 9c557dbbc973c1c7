// Put the parts together: fill the controls, draw what the address selects, listen.

function options(select, entries) {
  select.replaceChildren(...entries.map(([value, words]) => el("option", { value }, words)));
}

function fillControls() {
  byId("notices").replaceChildren(...DATA.notices.map((words) => el("p", { class: "notice", role: "note" }, words)));
  for (const [key, { colour }] of Object.entries(DATA.operations))
    document.documentElement.style.setProperty(`--${key}`, colour);
  options(
    byId("run"),
    DATA.runs.map((run) => [run.name, run.name]),
  );
  options(
    byId("level"),
    DATA.levels.map((level) => [level, level]),
  );
  for (const part of document.querySelectorAll("[data-memory]")) part.hidden = DATA.suite;
  byId("legend").hidden = DATA.suite;
  if (DATA.suite) byId("groups").textContent = "Suite";
  byId("run").parentElement.hidden = DATA.runs.length < 2;
  byId("to-compare").hidden = DATA.runs.length < 2;
  const types = DATA.memory_types.filter((type) => Object.values(DATA.tasks).some((task) => task.memory_type === type));
  options(byId("type"), [["", "all"], ...types.map((type) => [type, type])]);
  const operations = Object.entries(DATA.operations);
  options(byId("op"), [
    ["", "all"],
    ...operations.map(([key, { name }]) => [key, `with ${name}`]),
    ...operations.map(([key, { name }]) => [`missed-${key}`, `missed ${name}`]),
  ]);
  byId("legend").append(
    ...operations.map(([key, { name }]) => el("p", {}, shape(key, "full", true), name)),
    el("p", {}, shape("S", "full"), "full: held with all earlier checkpoints complete"),
    el("p", {}, shape("S", "hollow"), "hollow: first held, in whatever order"),
    el("p", {}, shape("S", "none"), "dashed: never held"),
    outcomeLegend(),
  );
}

/** Tasks of the chosen memory type only. */
function fillTasks(chosen) {
  const names = Object.keys(DATA.tasks).filter((name) => !chosen.type || DATA.tasks[name].memory_type === chosen.type);
  options(byId("task"), [["", "all"], ...names.map((name) => [name, taskTitle(name)])]);
}

/** Pairs are found by their difference too. */
function fillOutcomes(paired) {
  const outcomes = Object.entries(OUTCOMES).map(([key, { words }]) => [key, words]);
  options(byId("outcome"), [
    ["", "all"],
    ...(paired ? Object.entries(PAIR_OUTCOMES).map(([key, [words]]) => [key, words]) : []),
    outcomes[0],
    ["failed", "any failure"],
    ...outcomes.slice(1),
    ["no-video", "no video"],
  ]);
}

let drawn = {};

/** Draw what has changed since the last time. */
function draw() {
  const chosen = selection();
  const run = currentRun();
  const overview = chosen.view === "overview";
  const changed = (...keys) => keys.some((key) => drawn[key] !== chosen[key]);
  byId("overview").hidden = !overview;
  byId("episodes").hidden = overview;
  for (const [id, view] of [
    ["to-overview", "overview"],
    ["to-episodes", "episodes"],
    ["to-compare", "compare"],
  ]) {
    byId(id).href = address({ view });
    if (chosen.view === view) byId(id).setAttribute("aria-current", "page");
    else byId(id).removeAttribute("aria-current");
  }
  if (changed("type")) fillTasks(chosen);
  const compared = chosen.view === "compare";
  if (changed("view")) fillOutcomes(compared);
  if (changed("run"))
    options(
      byId("second"),
      others(chosen.run).map((name) => [name, name]),
    );
  byId("second").parentElement.hidden = !compared;
  for (const key of ["run", "second", "level", "type", "task", "op", "outcome"]) byId(key).value = chosen[key];
  const filters = FILTERS.filter((key) => key !== "q" && chosen[key]).length;
  byId("chosen").textContent = filters ? ` (${filters})` : "";
  if (document.activeElement !== byId("q")) byId("q").value = chosen.q;
  if (!compared) pair.clear();
  if (overview) detail.stop();
  if (overview) drawOverview(run, chosen);
  else drawEpisodes(run, chosen, changed("run", "second", "view", "level", ...FILTERS));
  document.title = `${overview || !list.selected ? run.name : taskTitle(list.selected.task)} · MEMOBench`;
  if (drawn.view === chosen.view && changed("ep") && byId("more").open === false) byId("detail").scrollIntoView();
  drawn = chosen;
}

function drawEpisodes(run, chosen, refill) {
  const second = chosen.view === "compare" ? runNamed(chosen.second) : null;
  if (refill) {
    const partners = second && new Map(second.episodes.map((episode) => [episode.id, episode]));
    const found = filtered(run, chosen, partners);
    const good = found.filter(solved).length;
    const others = partners && found.filter(({ id }) => solved(partners.get(id))).length;
    const all = partners ? run.episodes.filter(({ id }) => partners.has(id)) : run.episodes;
    byId("count").textContent = partners
      ? `${found.length} of ${plural(all.length, "pair")}, ${good} and ${others} succeeded`
      : `${found.length} of ${plural(all.length, "episode")}, ${good} succeeded`;
    byId("clear").hidden = FILTERS.every((key) => !chosen[key]);
    list.fill(found, partners);
  }
  // Without a selection, or where a filter hides it: side by side the first pair that ends differently, else the first.
  const differs = (it) => second && solved(it) !== solved(list.partners.get(it.id));
  const episode =
    list.episodes.find((it) => it.id === chosen.ep) ?? list.episodes.find(differs) ?? list.episodes[0];
  list.selected = episode;
  if (!episode) return (pair.clear(), detail.clear());
  list.mark(episode.id);
  if (second || detail.episode !== episode) detail.stop();
  if (!second) return detail.draw(run, episode, chosen);
  detail.episode = null;
  pair.draw([run, second], [episode, list.partners.get(episode.id)], chosen);
}

function listen() {
  addEventListener("hashchange", draw);
  for (const key of ["run", "second", "level", "task", "op", "outcome"])
    byId(key).addEventListener("change", (event) => select({ [key]: event.target.value }, { keepHistory: true }));
  byId("type").addEventListener("change", (event) =>
    select({ type: event.target.value, task: "" }, { keepHistory: true }),
  );
  byId("q").addEventListener("input", (event) => select({ q: event.target.value }));
  byId("filters").addEventListener("submit", (event) => event.preventDefault());
  byId("filters").addEventListener("reset", (event) => {
    event.preventDefault();
    byId("q").value = "";
    select(noFilters(), { keepHistory: true });
  });
  byId("help").addEventListener("click", () => byId("keys").showModal());
  byId("theme").addEventListener("click", () => {
    const now =
      document.documentElement.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    setTheme(now === "dark" ? "light" : "dark");
  });
  addEventListener("keydown", onKey);
}

/** Filters stay open where there is room for them; on a phone they are folded. */
function foldFilters() {
  const roomy = matchMedia("(min-width: 52rem)");
  const fold = () => (byId("more").open = roomy.matches);
  roomy.addEventListener("change", fold);
  fold();
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  try {
    localStorage.setItem("memobench-theme", theme);
  } catch {
    // Some browsers keep nothing for pages from disk.
  }
}

function onKey(event) {
  const typing = event.target.closest("input:not([type=range]), select, textarea, dialog");
  if (event.key === "Escape" && event.target === byId("q")) return byId("q").blur();
  if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
  const player = { episodes: detail.episode && detail, compare: pair.sides.length && pair }[selection().view];
  const step = event.shiftKey ? DATA.fps : 1;
  const actions = {
    j: () => list.move(1),
    k: () => list.move(-1),
    o: () => select({ view: "overview" }, { keepHistory: true }),
    e: () => select({ view: "episodes" }, { keepHistory: true }),
    s: () => select({ view: VIEWS.at(-1) }, { keepHistory: true }),
    "/": () => (selection().view === "overview" && select({ view: "episodes" }), byId("q").focus()),
    "?": () => byId("keys").showModal(),
    ArrowRight: player && (() => player.seek(Math.round(player.frame) + step)),
    ArrowLeft: player && (() => player.seek(Math.round(player.frame) - step)),
    "[": player && (() => player.jump(-1)),
    "]": player && (() => player.jump(1)),
    " ": player && !event.target.closest("button, a") && (() => player.toggle()),
  };
  const action = actions[event.key];
  if (!action) return;
  event.preventDefault();
  action();
}

let remembered = null;
try {
  remembered = localStorage.getItem("memobench-theme");
} catch {
  // as above
}
if (remembered === "light" || remembered === "dark") document.documentElement.dataset.theme = remembered;
fillControls();
foldFilters();
enableTips();
listen();
draw();
