// Which rollouts a selection finds.

/** Words in small letters, a space before and after each; "seed 8" counts as one. */
function normal(text) {
  const words = text.toLowerCase().replace(/[^\p{L}\p{N}]+/gu, " ");
  return ` ${words.replace(/\b(seed|episode) (?=\d)/g, "$1").trim()} `;
}

/** Everything that the search looks at; made once per rollout. */
function searchText(episode) {
  episode.words ??= normal(
    [
      episode.task,
      DATA.tasks[episode.task].language,
      `${DATA.tasks[episode.task].memory_type} ${DATA.tasks[episode.task].id ?? ""}`,
      OUTCOMES[episode.outcome].words,
      `episode ${episode.episode}`,
      `seed ${episode.seed}`,
      episode.scene ?? "",
      episode.scene?.slice(0, 8) ?? "",
      ...(DATA.tasks[episode.task].variants[episode.variant]?.checkpoints.flatMap((checkpoint) => checkpoint.texts) ??
        []),
    ].join(" "),
  );
  return episode.words;
}

/** Every word must begin a word of the rollout; numbers must be whole, so that seed 1 is not seed 10. */
const finds = (words, text) => words.every((word) => text.includes(/\d$/.test(word) ? ` ${word} ` : ` ${word}`));

/** `op` is an operation that a checkpoint must have, or "missed-" and an operation of one that never held. */
function hasOperation(episode, op) {
  const missed = op.startsWith("missed-");
  const wanted = missed ? op.slice(7) : op;
  return episode.checkpoints.some(([operation, first]) => operation === wanted && (!missed || first === null));
}

function hasOutcome(episode, outcome) {
  if (outcome === "failed") return !solved(episode);
  if (outcome === "no-video") return !episode.video;
  return episode.outcome === outcome;
}

const solved = (episode) => episode.outcome === "success";

/** Outcomes of a pair of rollouts, in addition to the outcomes of either. */
const PAIR_OUTCOMES = {
  differs: ["only one succeeded", (a, b) => solved(a) !== solved(b)],
  first: ["only the first succeeded", (a, b) => solved(a) && !solved(b)],
  second: ["only the second succeeded", (a, b) => !solved(a) && solved(b)],
  neither: ["neither succeeded", (a, b) => !solved(a) && !solved(b)],
};

/** The rollouts of a run that a selection finds; `partners` (by id) leaves those out that have none. */
function filtered(run, chosen, partners = null) {
  const words = normal(chosen.q).split(" ").filter(Boolean);
  const order = Object.keys(DATA.tasks);
  const found = ([episode, partner]) => {
    const both = partner ? [episode, partner] : [episode];
    const either = (test, value) => !value || both.some((it) => test(it, value));
    const pairwise = partner && PAIR_OUTCOMES[chosen.outcome]?.[1];
    return (
      (!chosen.type || DATA.tasks[episode.task].memory_type === chosen.type) &&
      (!chosen.task || episode.task === chosen.task) &&
      either(hasOperation, chosen.op) &&
      (pairwise ? pairwise(episode, partner) : either(hasOutcome, chosen.outcome)) &&
      finds(words, both.map(searchText).join(""))
    );
  };
  return run.episodes
    .map((episode) => [episode, partners?.get(episode.id)])
    .filter(([, partner]) => !partners || partner)
    .filter(found)
    .map(([episode]) => episode)
    .sort((a, b) => order.indexOf(a.task) - order.indexOf(b.task) || a.episode - b.episode);
}
