// What is selected is in the address after #, so a view can be bookmarked, sent to somebody and gone back to.

const KEYS = ["view", "run", "second", "type", "task", "op", "outcome", "q", "ep", "level"];
const VIEWS = DATA.runs.length > 1 ? ["overview", "episodes", "compare"] : ["overview", "episodes"];
const FILTERS = ["type", "task", "op", "outcome", "q"];

/** The selection that the address holds; unknown values fall back to what is there. */
function selection() {
  const given = new URLSearchParams(location.hash.slice(1));
  const chosen = Object.fromEntries(KEYS.map((key) => [key, given.get(key) ?? ""]));
  if (!DATA.runs.some((run) => run.name === chosen.run)) chosen.run = DATA.runs[0].name;
  if (!DATA.levels.includes(chosen.level)) chosen.level = "intermediate";
  if (!VIEWS.includes(chosen.view)) chosen.view = "overview";
  if (!others(chosen.run).includes(chosen.second)) chosen.second = others(chosen.run)[0] ?? "";
  return chosen;
}

/** Return the names of the other runs. */
const others = (name) => DATA.runs.map((run) => run.name).filter((it) => it !== name);

/** The address of the present selection with some changes. */
function address(changes) {
  const next = new URLSearchParams();
  const values = { ...selection(), ...changes };
  const defaults = { view: "overview", run: DATA.runs[0].name, level: "intermediate", second: others(values.run)[0] };
  for (const key of KEYS) if (values[key] && values[key] !== defaults[key]) next.set(key, values[key]);
  return `#${next}`;
}

/** Select something else. The page redraws by the event that the new address causes. */
function select(changes, { keepHistory = false } = {}) {
  const next = address(changes);
  if (next === (location.hash || "#")) return;
  if (keepHistory) location.hash = next;
  else location.replace(next);
}

const noFilters = () => Object.fromEntries(FILTERS.map((key) => [key, ""]));
const runNamed = (name) => DATA.runs.find((run) => run.name === name);
const currentRun = () => runNamed(selection().run);
