// The first view: rates with their intervals, outcomes, and every task.

const OPERATION_OF = { SR: null, MSR: "S", MUR: "U", MCR: "C" };
const METRICS = Object.fromEntries(DATA.metrics.map((metric) => [metric, OPERATION_OF[metric]]));
const METRIC_WORDS = {
  SR: "success rate: the goal holds at the end",
  MSR: "memory storage rate: Storage checkpoints that held at some step",
  MUR: "memory update rate: Update checkpoints that held at some step",
  MCR: "memory compression rate: Compression checkpoints that held at some step",
};

const RATES_HINT =
  `Per cent; the line is Wilson’s 95 % interval over n rollouts. A ${DATA.suite ? "suite" : "memory type"} is the mean ` +
  `over its tasks, the average over the ${DATA.suite ? "suites" : "memory types, as far as a metric applies"}.`;

/** A rate as a number above its interval on a scale from 0 to 100. */
function rateCell(rate, metric) {
  if (!rate) return el("td", { class: "rate" }, el("span", { class: "absent", "aria-label": "not applicable" }, "–"));
  const [value, low, high, n] = rate;
  const words = `${metric} ${value.toFixed(1)} %, 95 % interval ${low.toFixed(1)} to ${high.toFixed(1)}, n = ${n}`;
  return el(
    "td",
    { class: `rate op-${METRICS[metric] ?? "none"}`, "data-tip": words },
    el("span", { class: "value" }, value.toFixed(1)),
    el("span", { class: "visually-hidden" }, ` (${low.toFixed(1)} to ${high.toFixed(1)})`),
    el(
      "span",
      { class: "interval", "aria-hidden": "true" },
      el("span", { class: "whisker", style: { left: `${low}%`, width: `${high - low}%` } }),
      el("span", { class: "dot", style: { left: `${value}%` } }),
    ),
  );
}

function rateHead(...before) {
  const metrics = DATA.metrics.map((metric) =>
    el(
      "th",
      { scope: "col", class: "rate", "data-tip": capital(METRIC_WORDS[metric]) },
      METRICS[metric] ? shape(METRICS[metric]) : null,
      metric,
    ),
  );
  return el("tr", {}, before, metrics);
}

const rateCells = (row) => DATA.metrics.map((metric) => rateCell(row?.[metric], metric));

/** Rates per memory type; several runs stand under one another. */
function summaryTable(run) {
  const several = DATA.runs.length > 1;
  const groups = [["average", "Average"], ...DATA.memory_types.map((type) => [type, groupName(type)])];
  const rowOf = (it, key) => (key === "average" ? it.average : it.memory_types[key]);
  const bodies = groups.map(([key, words]) => {
    const runs = DATA.runs.filter((it) => rowOf(it, key));
    const rows = runs.map((it, k) =>
      el(
        "tr",
        { class: it === run && several ? "chosen" : null },
        k === 0 ? el("th", { scope: "rowgroup", rowspan: runs.length, class: "what" }, words) : null,
        several
          ? el("th", { scope: "row", class: "run" }, el("a", { href: address({ run: it.name }) }, it.name))
          : null,
        el("td", { class: "number" }, String(rowOf(it, key).SR[3])),
        rateCells(rowOf(it, key)),
      ),
    );
    return runs.length ? el("tbody", { class: key === "average" ? "average" : null }, rows) : null;
  });
  const head = [
    el("th", { scope: "col" }, DATA.suite ? "Suite" : "Memory"),
    several ? el("th", { scope: "col" }, "Run") : null,
    el("th", { scope: "col", class: "number", "data-tip": "Rollouts" }, "n"),
  ];
  return el("table", { class: "rates" }, el("thead", {}, rateHead(...head)), bodies);
}

/** How rollouts ended, as one bar whose parts lead to the rollouts. */
function outcomeBar(counts, where) {
  const total = Object.values(counts).reduce((sum, count) => sum + count, 0);
  const parts = Object.keys(OUTCOMES).filter((outcome) => counts[outcome]);
  return el(
    "span",
    { class: "outcomes" },
    parts.map((outcome) =>
      el(
        "a",
        {
          class: `part is-${outcome}`,
          style: { "flex-grow": String(counts[outcome]) },
          href: address({ ...noFilters(), ...where, view: "episodes", outcome, ep: "" }),
          "aria-label": `${counts[outcome]} of ${total}: ${OUTCOMES[outcome].words}`,
          "data-tip": `${counts[outcome]} of ${total}: ${OUTCOMES[outcome].words}\n${OUTCOMES[outcome].why}`,
        },
        el("b", {}, OUTCOMES[outcome].letter),
        el("span", {}, ` ${counts[outcome]}`),
      ),
    ),
  );
}

function countOutcomes(run, keep) {
  const counts = {};
  for (const episode of run.episodes) if (keep(episode)) counts[episode.outcome] = (counts[episode.outcome] ?? 0) + 1;
  return counts;
}

function outcomeTable(run) {
  const row = (words, counts, where) =>
    el("tr", {}, el("th", { scope: "row" }, words), el("td", { class: "wide" }, outcomeBar(counts, where)));
  const there = DATA.memory_types.filter((type) => run.memory_types[type]);
  const types = DATA.suite && there.length === 1 ? [] : there;
  return el(
    "table",
    { class: "endings" },
    el(
      "tbody",
      {},
      row(
        "All",
        countOutcomes(run, () => true),
        {},
      ),
      types.map((type) =>
        row(
          groupName(type),
          countOutcomes(run, (e) => DATA.tasks[e.task].memory_type === type),
          { type },
        ),
      ),
    ),
  );
}

const outcomeLegend = (counts) =>
  el(
    "ul",
    { class: "key" },
    Object.entries(OUTCOMES).map(([outcome, { words, why }]) =>
      el(
        "li",
        { "data-tip": why },
        outcomeMark(outcome),
        words,
        counts ? el("b", {}, String(counts[outcome] ?? 0)) : null,
      ),
    ),
  );

/** Each checkpoint with the share of rollouts that completed it and all before it in order. */
function prefixChips(task, numbers, level) {
  return el(
    "span",
    { class: "chips" },
    [...numbers.operations].map((operation, k) => {
      const [ordered, any] = [numbers.ordered_prefix[k][0], numbers.prefix[k][0]];
      const rates = `${ordered.toFixed(1)} % got here in order, ${any.toFixed(1)} % in any order`;
      const tip = `${capital(checkpointText(task, anyVariant(task), k, level))}\n${rates}`;
      return el(
        "span",
        { class: `chip op-${operation}`, "data-tip": tip },
        shape(operation, "full", true),
        ordered.toFixed(0),
      );
    }),
  );
}

const anyVariant = (task) => Object.keys(DATA.tasks[task].variants)[0] ?? "0";

function tasksTable(run, type, level) {
  const names = Object.keys(run.tasks).filter((name) => DATA.tasks[name].memory_type === type);
  const rows = names.map((name) => {
    const numbers = run.tasks[name];
    return el(
      "tr",
      {},
      el(
        "th",
        { scope: "row", class: "task" },
        el("a", { href: address({ ...noFilters(), view: "episodes", task: name, ep: "" }) }, taskTitle(name)),
      ),
      el("td", { class: "number" }, String(numbers.rates.SR[3])),
      rateCells(numbers.rates),
      DATA.suite ? null : el("td", {}, prefixChips(name, numbers, level)),
      el("td", { class: "ends" }, outcomeBar(numbers.outcomes, { task: name })),
    );
  });
  const head = rateHead(
    el("th", { scope: "col", class: "task" }, `${groupName(type)} · ${plural(names.length, "task")}`),
    el("th", { scope: "col", class: "number" }, "n"),
  );
  head.append(
    DATA.suite
      ? ""
      : el(
          "th",
          {
            scope: "col",
            class: "chipped",
            "data-tip": "Per checkpoint: rollouts, in per cent, that completed it and all before it in order",
          },
          "Checkpoints",
        ),
    el("th", { scope: "col", class: "ends" }, "Outcomes"),
  );
  return el(
    "div",
    { class: "scroll", tabindex: "0", role: "region", "aria-label": `${type} tasks` },
    el("table", { class: "rates tasks" }, el("thead", {}, head), el("tbody", {}, rows)),
  );
}

/** A link that saves a table as CSV. */
function csvLink(run, key, words, short = "CSV") {
  const file = `${run.name}-${key}.csv`.replace(/[^\w.-]+/g, "_");
  if (!(key in run.csv)) return null;
  const href = `data:text/csv;charset=utf-8,${encodeURIComponent(run.csv[key])}`;
  return el("a", { class: "csv", href, download: file, "aria-label": `${words} as CSV` }, short);
}

function drawOverview(run, chosen) {
  const types = DATA.memory_types.filter((type) => run.memory_types[type]);
  byId("overview").replaceChildren(
    el("h2", { id: "overview-title" }, DATA.runs.length > 1 ? `${run.name}: ${run.headline}` : run.headline),
    el(
      "p",
      { class: "facts" },
      run.facts.map((words) => el("span", {}, words)),
    ),
    run.commands.length
      ? el(
          "details",
          {},
          el("summary", {}, "How it was run"),
          run.commands.map((words) => el("pre", {}, el("code", {}, words))),
        )
      : "",
    ...run.notes.map((note) => el("p", { class: "notice" }, note)),
    el(
      "div",
      { class: "columns" },
      el(
        "section",
        {},
        el("h3", {}, "Rates", csvLink(run, "memory-types", DATA.suite ? "Rates by suite" : "Rates by memory type")),
        el("div", { class: "scroll" }, summaryTable(run)),
        el("p", { class: "hint" }, RATES_HINT),
      ),
      el(
        "section",
        {},
        el("h3", {}, "How rollouts end", csvLink(run, "failures", "Outcomes")),
        outcomeTable(run),
        outcomeLegend(countOutcomes(run, () => true)),
      ),
    ),
    el("h3", {}, "Tasks", csvLink(run, "tasks", "Rates by task"), csvLink(run, "prefix", "Prefix completion", "checkpoints, CSV")),
    ...types.map((type) => tasksTable(run, type, chosen.level)),
  );
}
