// One rollout: its video, the timeline that goes with it, and its task in this run.

const detail = {
  episode: null,
  frame: 0,

  draw(run, episode, chosen) {
    const same = this.episode === episode && this.run === run;
    if (same && this.level === chosen.level) return this.refreshLinks();
    const frame = same ? this.frame : 0;
    Object.assign(this, { run, episode, level: chosen.level });
    const task = DATA.tasks[episode.task];
    this.line = timeline(episode, chosen.level, (to) => this.seek(to));
    if (!same) this.stage = stage(episode, (at) => this.show(at));
    this.now = el("p", { class: "now" });
    byId("detail").replaceChildren(
      el(
        "header",
        {},
        el("h2", {}, taskTitle(episode.task)),
        el(
          "p",
          { class: "facts" },
          outcomeMark(episode.outcome),
          el("b", {}, capital(OUTCOMES[episode.outcome].words)),
          episodeFacts(episode, task).map((words) => el("span", {}, words)),
        ),
      ),
      this.stage.root,
      this.now,
      this.line.root,
      el(
        "p",
        { class: "hint why" },
        episode.outcome === "success"
          ? null
          : el("b", {}, `${capital(OUTCOMES[episode.outcome].words)}. ${episode.fault ?? OUTCOMES[episode.outcome].why}`),
        markLegend(),
      ),
      (this.others = el("nav", { class: "others", "aria-label": "The same episode in other runs" })),
      (this.panel = taskPanel(run, episode, chosen.level)),
    );
    this.refreshLinks();
    this.show(frame);
  },

  /** Links hold the whole address, so they are made again when any part of it changes. */
  refreshLinks() {
    const links = DATA.runs
      .filter((run) => run !== this.run)
      .map((run) => [run, run.episodes.find((episode) => episode.id === this.episode.id)])
      .filter(([, episode]) => episode)
      .map(([run, episode]) =>
        el("a", { href: address({ run: run.name, ep: episode.id }) }, outcomeMark(episode.outcome), run.name),
      );
    const pair = el("a", { href: address({ view: "compare", ep: this.episode.id }) }, "side by side");
    this.others.replaceChildren(...(links.length ? ["Same episode in ", ...links, pair] : []));
  },

  clear() {
    this.stop();
    this.episode = null;
    byId("detail").replaceChildren(el("p", { class: "hint empty" }, "No episode is selected."));
  },

  toggle() {
    this.stage.toggle();
  },

  stop() {
    this.stage?.stop();
  },

  /** Go to a frame, in the video where there is one. */
  seek(frame) {
    const to = Math.min(Math.max(frame, 0), lastFrame(this.episode));
    this.stage.seek(to);
    this.show(to);
  },

  /** Jump to the next checkpoint's mark in a direction (1 or -1). */
  jump(direction) {
    const frames = [...this.line.root.querySelectorAll(".mark")].map((mark) => Number(mark.dataset.frame));
    const ahead = frames.filter((frame) => (frame - this.frame) * direction > 0);
    if (ahead.length) this.seek(direction > 0 ? Math.min(...ahead) : Math.max(...ahead));
  },

  /** Draw what belongs to a frame. */
  show(frame) {
    this.frame = Math.min(frame, lastFrame(this.episode));
    this.line.show(this.frame);
    showSubgoal(this.now, this.episode, this.frame, this.level);
  },
};

/** Write into `line` what is to be done at a frame. */
function showSubgoal(line, episode, frame, level) {
  const now = situation(episode, frame);
  const operation = now.phase !== "prompt" && now.checkpoint !== null ? episode.checkpoints[now.checkpoint][0] : null;
  const key = `${now.phase} ${now.checkpoint}`;
  if (line.dataset.key === key) return;
  line.dataset.key = key;
  line.className = `now ${now.phase}`;
  line.replaceChildren(
    operation ? badge(operation) : "",
    el("span", {}, el("span", { class: "quiet" }, whenWords(now)), subgoalWords(episode, now, level)),
  );
}

function whenWords({ phase, checkpoint }) {
  if (phase === "prompt") return "";
  if (phase === "execution") return checkpoint === null ? "" : "Next checkpoint: ";
  return checkpoint === null ? "At the end: " : "Still open at the end: ";
}

function episodeFacts(episode, task, { length = true } = {}) {
  const words = [`episode ${episode.episode}`, episode.seed === null ? null : `seed ${episode.seed}`, task.memory_type];
  if (episode.referent !== "fixed") words.push(`${episode.referent} referent, variant ${episode.variant}`);
  words.push(length ? plural(episode.steps, "step") : null, episode.scene ? `scene ${episode.scene.slice(0, 8)}` : null);
  return words.filter(Boolean);
}
