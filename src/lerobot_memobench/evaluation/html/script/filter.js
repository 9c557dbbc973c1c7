// Which rollouts a selection finds.

/** Everything that the search looks at, in small letters; made once per rollout. */
function searchText(episode) {
  episode.words ??= [
    episode.task, DATA.tasks[episode.task].language, DATA.tasks[episode.task].memory_type, OUTCOMES[episode.outcome].words,
    `episode ${episode.episode}`, `seed ${episode.seed}`, episode.scene,
    ...(DATA.tasks[episode.task].variants[episode.variant]?.checkpoints.flatMap((checkpoint) => checkpoint.texts) ?? []),
  ].join("\n").toLowerCase();
  return episode.words;
}

/** `op` is an operation that a checkpoint must have, or "missed-" and an operation of one that never held. */
function hasOperation(episode, op) {
  const missed = op.startsWith("missed-");
  const wanted = missed ? op.slice(7) : op;
  return episode.checkpoints.some(([operation, first]) => operation === wanted && (!missed || first === null));
}

function hasOutcome(episode, outcome) {
  if (outcome === "failed") return episode.outcome !== "success";
  if (outcome === "no-video") return !episode.video;
  return episode.outcome === outcome;
}

function filtered(run, chosen) {
  const words = chosen.q.toLowerCase().split(/\s+/).filter(Boolean);
  const order = Object.keys(DATA.tasks);
  return run.episodes
    .filter(
      (episode) =>
        (!chosen.type || DATA.tasks[episode.task].memory_type === chosen.type) &&
        (!chosen.task || episode.task === chosen.task) &&
        (!chosen.op || hasOperation(episode, chosen.op)) &&
        (!chosen.outcome || hasOutcome(episode, chosen.outcome)) &&
        words.every((word) => searchText(episode).includes(word)),
    )
    .sort((a, b) => order.indexOf(a.task) - order.indexOf(b.task) || a.episode - b.episode);
}
