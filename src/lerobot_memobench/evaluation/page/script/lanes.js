// The lanes of a timeline: phases, one per checkpoint, and the axis of time. Together the checkpoints' lanes are a
// staircase: each is worked on until it holds with all earlier ones complete.

/** What draws on tracks of `length` frames, frame 0 being `lead` into them; marks call `seek` with their frame. */
function trackTools(length, lead, seek) {
  const share = (frames) => `${(100 * frames) / Math.max(1, length)}%`;
  const at = (frame) => share(frame + lead);
  const span = (from, to, kind, tip, words = "") =>
    el("span", { class: `span ${kind}`, style: { left: at(from), width: share(to - from) }, "data-tip": tip }, words);
  const mark = (frame, kind, tip, content) =>
    el(
      "button",
      {
        type: "button",
        class: `mark ${kind}`,
        style: { left: at(frame) },
        "data-frame": frame,
        "data-tip": tip,
        "aria-label": `${tip.replaceAll("\n", ", ")}; show it`,
        on: { click: () => seek(frame) },
      },
      content,
    );
  const lane = (kind, label, ...things) =>
    el("div", { class: `lane ${kind}` }, el("div", { class: "label" }, label), el("div", { class: "track" }, things));
  return { at, span, mark, lane };
}

function phaseLane(episode, draw) {
  const end = lastFrame(episode);
  const { words, letter, why } = OUTCOMES[episode.outcome];
  const prompt = `Prompt video, ${seconds(episode.prompt)}\nThe policy watches; its actions have no effect.`;
  const execution = `Execution, ${plural(episode.steps, "step")}, ${seconds(episode.steps)}`;
  return draw.lane(
    "phases",
    el("span", { class: "words" }, "Phase"),
    episode.prompt ? draw.span(0, episode.prompt, "prompt", prompt, "prompt") : null,
    draw.span(episode.prompt, end, "execution", execution, "execution"),
    draw.mark(end, `ending is-${episode.outcome}`, `${capital(words)} at step ${episode.steps}\n${why}`, letter),
  );
}

function checkpointLane(episode, k, level, draw) {
  const [operation, first, ordered] = episode.checkpoints[k];
  const text = checkpointText(episode.task, episode.variant, k, level);
  const place = `Subgoal ${k + 1} of ${episode.checkpoints.length} · ${operationName(operation)}`;
  const tip = [place, ...(checkpointTexts(episode.task, episode.variant, k) ?? [text])].join("\n");
  const state = ordered !== null ? `step ${ordered}` : first !== null ? `(step ${first})` : "never";
  return draw.lane(
    "checkpoint",
    [badge(operation), el("span", { class: "words", "data-tip": tip }, text), el("span", { class: "when" }, state)],
    workedOn(episode, k, tip, draw),
    checkpointSteps(episode, k, `${operationName(operation)} ${k + 1}: ${text}`, draw),
  );
}

/** The time during which a checkpoint is the one worked on: from the completion of the one before to its own. */
function workedOn(episode, k, tip, draw) {
  const from = k === 0 ? 0 : episode.checkpoints[k - 1][2];
  if (from === null) return null;
  const [operation, , ordered] = episode.checkpoints[k];
  const kind = `active op-${operation}${ordered === null ? " open" : ""}`;
  return draw.span(frameOf(episode, from), frameOf(episode, ordered ?? episode.steps), kind, tip);
}

/** The marks of a checkpoint: hollow where it first held, full where it held in order, a cross where it names the
    failure. */
function checkpointSteps(episode, k, what, draw) {
  const [operation, first, ordered] = episode.checkpoints[k];
  const kind = `op-${operation}`;
  const marks = [];
  if (first !== null && first !== ordered) {
    const [frame, never] = [frameOf(episode, first), ordered === null ? ", never in order" : ""];
    if (ordered !== null) marks.push(draw.span(frame, frameOf(episode, ordered), `wait ${kind}`, what));
    marks.push(draw.mark(frame, kind, `${what}\nfirst held at step ${first}${never}`, shape(operation, "hollow")));
  }
  if (ordered !== null) {
    const how = first === ordered ? "first held, and in order," : "held in order";
    const tip = `${what}\n${how} at step ${ordered}`;
    marks.push(draw.mark(frameOf(episode, ordered), kind, tip, shape(operation, "full")));
  }
  if (k === missingCheckpoint(episode)) {
    const tip = `${what}\nnever held: ${OUTCOMES[episode.outcome].words}`;
    marks.push(draw.mark(lastFrame(episode), `ending cause is-${episode.outcome}`, tip, "✕"));
  }
  return marks;
}

function timeSlider(end, room, draw) {
  const labels = ticks(room).map((frame) =>
    el("span", { class: "tick", style: { left: draw.at(frame) } }, `${frame / DATA.fps} s`),
  );
  const range = { "aria-valuemin": "0", "aria-valuemax": end };
  return el("div", { class: "track axis", role: "slider", tabindex: "0", "aria-label": "Time", ...range }, labels);
}

/** Round times for the axis, in frames: five to eight of them. */
function ticks(end) {
  const steps = [1, 2, 5, 10, 20, 30, 60, 120, 300].map((s) => s * DATA.fps);
  const step = steps.find((it) => end / it <= 7) ?? steps.at(-1);
  const all = Array.from({ length: Math.floor(end / step) + 1 }, (_, k) => k * step);
  return all.filter((frame) => frame === 0 || frame <= end * 0.94); // the last label must not leave the track
}

/** What the signs on a timeline mean. */
const markLegend = () =>
  el(
    "span",
    { class: "signs", hidden: DATA.suite },
    el("span", {}, shape("S", "hollow"), " first held"),
    el("span", {}, shape("S", "full"), " held in order"),
    el("span", {}, el("span", { class: "sample active op-S" }), " being worked on"),
    el("span", {}, el("span", { class: "sample open op-S" }), " never completed"),
  );
