// The timeline of one rollout, drawn from the log alone. Frame k shows the world after k control steps; the prompt
// comes first, execution step s is frame prompt + s.

const frameOf = (episode, step) => episode.prompt + step;
const lastFrame = (episode) => episode.prompt + episode.steps;

/** What happens at a frame: phase, step of that phase, and the checkpoint being worked on (null: none is left). */
function situation(episode, frame) {
  if (frame < episode.prompt) return { phase: "prompt", step: frame, checkpoint: null };
  const step = frame - episode.prompt;
  const next = episode.checkpoints.findIndex(([, , ordered]) => ordered === null || ordered > step);
  const ended = step >= episode.steps;
  return { phase: ended ? "end" : "execution", step, checkpoint: next < 0 ? null : next };
}

/** The checkpoint that names the failure; null for a success, and where none is missing. */
function missingCheckpoint(episode) {
  if (["success", "execution_failure", "hand", "invalid_action", "unstable_physics"].includes(episode.outcome)) return null;
  const missing = episode.checkpoints.findIndex(([, first]) => first === null);
  return missing < 0 ? null : missing;
}

/** Make a timeline. `seek` is called with a frame; the result's `show` moves the playhead there. The track is `length`
    frames long, and the rollout begins `lead` frames into it: two rollouts can be drawn on one scale. */
function timeline(episode, level, seek, length = lastFrame(episode), lead = 0) {
  const end = lastFrame(episode);
  const draw = trackTools(length, lead, seek);
  const lanes = episode.checkpoints.map((_, k) => checkpointLane(episode, k, level, draw));
  const slider = timeSlider(end, length - lead, draw);
  const read = readLanes(episode, draw, seek);
  const clock = el("span", { class: "words clock" });
  const root = el(
    "div",
    { class: "timeline", role: "group", "aria-label": "Timeline" },
    phaseLane(episode, draw),
    lanes,
    read.lanes,
    el("div", { class: "lane" }, el("div", { class: "label" }, clock), slider),
  );
  root.addEventListener("pointerdown", (event) => drag(event, root, slider, (across) => seek(Math.round(across * length) - lead)));
  slider.addEventListener("keydown", (event) => {
    const jump = { Home: -Infinity, End: Infinity, PageUp: -DATA.fps, PageDown: DATA.fps }[event.key];
    if (jump === undefined) return;
    event.preventDefault();
    seek(Number(slider.getAttribute("aria-valuenow")) + jump);
  });

  const show = (frame) => {
    const now = situation(episode, frame);
    const [name, count] = now.phase === "prompt" ? ["prompt step", episode.prompt] : ["step", episode.steps];
    const words = `${name} ${now.step} of ${count}`;
    root.style.setProperty("--at", draw.at(frame));
    slider.setAttribute("aria-valuenow", frame);
    slider.setAttribute("aria-valuetext", `${words}, ${subgoalWords(episode, now, level)}`);
    read.show(frame);
    clock.textContent = `${words} · ${seconds(frame)}`;
    lanes.forEach((lane, k) => {
      const acting = now.phase !== "prompt";
      lane.classList.toggle("now", acting && k === now.checkpoint);
      lane.classList.toggle("done", acting && (now.checkpoint === null || k < now.checkpoint));
    });
  };
  return { root, show };
}

/** The words under the video: what is to be done now. */
function subgoalWords(episode, now, level) {
  if (now.phase === "prompt") return "watch the prompt";
  if (now.phase === "end" && episode.outcome === "success") return "done";
  if (DATA.suite) return now.phase === "end" ? "the goal does not hold" : "";
  if (now.checkpoint === null && now.phase === "end") return "every checkpoint is complete, the goal does not hold";
  if (now.checkpoint === null) return "every checkpoint is complete";
  return checkpointText(episode.task, episode.variant, now.checkpoint, level);
}

/** Report the place of the pointer, from 0 to 1, and follow it while it is held down. Marks and cells seek by their own click. */
function drag(event, root, slider, moved) {
  if (event.button !== 0 || event.target.closest(".mark, .cell") || !event.target.closest(".track")) return;
  const follow = ({ clientX }) => {
    const box = slider.getBoundingClientRect();
    moved((clientX - box.left) / box.width);
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
