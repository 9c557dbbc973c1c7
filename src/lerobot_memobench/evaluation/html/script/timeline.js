// The timeline of one rollout, drawn from the log alone. Frame k shows the world after k control steps; the prompt comes
// first, execution step s is frame prompt + s.

const frameOf = (episode, step) => episode.prompt + step;
const lastFrame = (episode) => episode.prompt + episode.steps;

/** What the rollout is doing at a frame: phase, execution step, and the checkpoint being worked on (null: none left). */
function situation(episode, frame) {
  if (frame < episode.prompt) return { phase: "prompt", step: frame, checkpoint: null };
  const step = frame - episode.prompt;
  const next = episode.checkpoints.findIndex(([, , ordered]) => ordered === null || ordered > step);
  const ended = step >= episode.steps;
  return { phase: ended ? "end" : "execution", step, checkpoint: next < 0 ? null : next };
}

/** Why the rollout failed, on the checkpoint that shows it; null for a success and where no checkpoint does. */
function missingCheckpoint(episode) {
  if (episode.outcome === "success" || episode.outcome === "execution_failure") return null;
  const missing = episode.checkpoints.findIndex(([, first]) => first === null);
  return missing < 0 ? null : missing;
}

function timeline(episode, level, seek) {
  const end = lastFrame(episode);
  const at = (frame) => `${(100 * frame) / Math.max(1, end)}%`;
  const span = (from, to, kind, tip, words = "") =>
    el("span", { class: `span ${kind}`, style: { left: at(from), width: at(to - from) }, "data-tip": tip }, words);
  const mark = (frame, kind, words, content) =>
    el(
      "button",
      { type: "button", class: `mark ${kind}`, style: { left: at(frame) }, "data-frame": frame, "data-tip": words, "aria-label": `${words.replaceAll("\n", ", ")}; show it`, on: { click: () => seek(frame) } },
      content,
    );
  const lane = (kind, label, ...things) =>
    el("div", { class: `lane ${kind}` }, el("div", { class: "label" }, label), el("div", { class: "track" }, things));

  const ending = OUTCOMES[episode.outcome];
  const phases = lane(
    "phases",
    el("span", { class: "words" }, "Phase"),
    episode.prompt ? span(0, episode.prompt, "prompt", `Prompt video, ${seconds(episode.prompt)}\nThe policy watches; its actions have no effect.`, "prompt") : null,
    span(episode.prompt, end, "execution", `Execution, ${plural(episode.steps, "step")}, ${seconds(episode.steps)}`, "execution"),
    mark(end, `ending is-${episode.outcome}`, `${capital(ending.words)} at step ${episode.steps}\n${ending.why}`, ending.letter),
  );

  const missing = missingCheckpoint(episode);
  let from = 0;
  const lanes = episode.checkpoints.map(([operation, first, ordered], k) => {
    const texts = checkpointTexts(episode.task, episode.variant, k);
    const text = checkpointText(episode.task, episode.variant, k, level);
    const what = `${operationName(operation)} ${k + 1}: ${text}`;
    const tip = [`Subgoal ${k + 1} of ${episode.checkpoints.length} · ${operationName(operation)}`, ...(texts ?? [text])].join("\n");
    const active = from !== null ? span(frameOf(episode, from), frameOf(episode, ordered ?? episode.steps), `active op-${operation}${ordered === null ? " open" : ""}`, tip) : null;
    const marks = [];
    if (first !== null && first !== ordered) {
      const frame = frameOf(episode, first);
      if (ordered !== null) marks.push(span(frame, frameOf(episode, ordered), `wait op-${operation}`, what));
      marks.push(mark(frame, `op-${operation}`, `${what}\nfirst held at step ${first}${ordered === null ? ", never in order" : ""}`, shape(operation, "hollow")));
    }
    if (ordered !== null) {
      const both = first === ordered ? "first held, and in order," : "held in order";
      marks.push(mark(frameOf(episode, ordered), `op-${operation}`, `${what}\n${both} at step ${ordered}`, shape(operation, "full")));
    }
    if (k === missing) {
      marks.push(mark(end, `ending cause is-${episode.outcome}`, `${what}\nnever held: ${ending.words}`, "✕"));
    }
    from = from === null ? null : ordered;
    const state = ordered !== null ? `step ${ordered}` : first !== null ? `(step ${first})` : "never";
    return lane("checkpoint", [badge(operation), el("span", { class: "words", "data-tip": tip }, text), el("span", { class: "when" }, state)], active, marks);
  });

  const slider = el("div", { class: "track axis", role: "slider", tabindex: "0", "aria-label": "Time", "aria-valuemin": "0", "aria-valuemax": end }, ticks(end).map((frame) => el("span", { class: "tick", style: { left: at(frame) } }, `${frame / DATA.fps} s`)));
  const clock = el("span", { class: "words clock" });
  const root = el("div", { class: "timeline", role: "group", "aria-label": "Timeline" }, phases, lanes, el("div", { class: "lane" }, el("div", { class: "label" }, clock), slider));
  root.addEventListener("pointerdown", (event) => drag(event, root, slider, end, seek));
  slider.addEventListener("keydown", (event) => {
    const jump = { Home: -Infinity, End: Infinity, PageUp: -DATA.fps, PageDown: DATA.fps }[event.key];
    if (jump === undefined) return;
    event.preventDefault();
    seek(Number(slider.getAttribute("aria-valuenow")) + jump);
  });

  /** Move the playhead. */
  const show = (frame) => {
    const now = situation(episode, frame);
    const words = now.phase === "prompt" ? `prompt step ${now.step} of ${episode.prompt}` : `step ${now.step} of ${episode.steps}`;
    root.style.setProperty("--at", at(frame));
    slider.setAttribute("aria-valuenow", frame);
    slider.setAttribute("aria-valuetext", `${words}, ${subgoalWords(episode, now, level)}`);
    clock.textContent = `${words} · ${seconds(frame)}`;
    lanes.forEach((element, k) => {
      element.classList.toggle("now", now.phase !== "prompt" && k === now.checkpoint);
      element.classList.toggle("done", now.phase !== "prompt" && (now.checkpoint === null || k < now.checkpoint));
    });
  };
  return { root, show };
}

/** The words under the video: what is to be done now. */
function subgoalWords(episode, now, level) {
  if (now.phase === "prompt") return "watch the prompt";
  if (now.phase === "end" && episode.outcome === "success") return "done";
  if (now.checkpoint === null) return now.phase === "end" ? "every checkpoint is complete, the goal does not hold" : "every checkpoint is complete";
  return checkpointText(episode.task, episode.variant, now.checkpoint, level);
}

/** Seek to the pointer, and follow it while it is held down. Marks seek by their own click. */
function drag(event, root, slider, end, seek) {
  if (event.button !== 0 || event.target.closest(".mark") || !event.target.closest(".track")) return;
  const follow = ({ clientX }) => {
    const box = slider.getBoundingClientRect();
    seek(Math.round(((clientX - box.left) / box.width) * end));
  };
  const stop = () => {
    root.removeEventListener("pointermove", follow);
    root.classList.remove("dragging");
  };
  root.classList.add("dragging");
  root.setPointerCapture(event.pointerId);
  root.addEventListener("pointermove", follow);
  root.addEventListener("pointerup", stop, { once: true });
  root.addEventListener("pointercancel", stop, { once: true });
  follow(event);
}

/** Round times for the axis, in frames: five to eight of them. */
function ticks(end) {
  const steps = [1, 2, 5, 10, 20, 30, 60, 120, 300].map((s) => s * DATA.fps);
  const step = steps.find((it) => end / it <= 7) ?? steps.at(-1);
  return Array.from({ length: Math.floor(end / step) + 1 }, (_, k) => k * step).filter((frame) => frame === 0 || frame <= end * 0.96);
}
