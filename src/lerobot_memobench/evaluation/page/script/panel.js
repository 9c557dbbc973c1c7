// The task of a rollout in its run: rates, checkpoints with their texts, and how many rollouts got that far.

function taskPanel(run, episode, level) {
  const numbers = run.tasks[episode.task];
  const goal = DATA.tasks[episode.task].variants[episode.variant]?.goal;
  return el(
    "section",
    { class: "panel" },
    el("h3", {}, `This task in ${run.name}`),
    el("div", { class: "scroll" }, taskRates(episode.task, numbers)),
    ...(DATA.suite
      ? []
      : [
          checkpointTable(episode, numbers, level),
          el("p", { class: "hint" }, "Rollouts that completed a checkpoint and all before it."),
        ]),
    goal ? el("details", { class: "goal" }, el("summary", {}, "Goal, as a formula"), el("code", {}, goal)) : null,
  );
}

function taskRates(task, numbers) {
  const head = rateHead(el("th", { scope: "col", class: "number" }, "n"));
  head.append(el("th", { scope: "col", class: "ends" }, "Outcomes"));
  const row = el(
    "tr",
    {},
    el("td", { class: "number" }, String(numbers.rates.SR[3])),
    rateCells(numbers.rates),
    el("td", {}, outcomeBar(numbers.outcomes, { task })),
  );
  return el("table", { class: "rates" }, el("thead", {}, head), el("tbody", {}, row));
}

function checkpointTable(episode, numbers, level) {
  const goals = DATA.tasks[episode.task].variants[episode.variant]?.checkpoints;
  const rows = [...numbers.operations].map((operation, k) =>
    el(
      "tr",
      {},
      el("td", {}, badge(operation)),
      el("th", { scope: "row", "data-tip": goals?.[k]?.goal }, checkpointText(episode.task, episode.variant, k, level)),
      prefixCell(numbers.ordered_prefix[k], operation, "full"),
      prefixCell(numbers.prefix[k], operation, "hollow"),
    ),
  );
  const head = el(
    "tr",
    {},
    el("th", { scope: "col", colspan: "2" }, "Checkpoint"),
    el("th", { scope: "col" }, "in order, %"),
    el("th", { scope: "col" }, "any order, %"),
  );
  return el("table", { class: "checkpoints" }, el("thead", {}, head), el("tbody", {}, rows));
}

function prefixCell([value, low, high, n], operation, kind) {
  const tip = `95 % interval ${low.toFixed(1)} to ${high.toFixed(1)}, n = ${n}`;
  const bar = el("span", { style: { width: `${value}%` } });
  return el(
    "td",
    { class: "prefix" },
    el("span", { class: `bar op-${operation} ${kind}`, "aria-hidden": "true" }, bar),
    el("span", { class: "number", "data-tip": tip }, value.toFixed(1)),
  );
}
