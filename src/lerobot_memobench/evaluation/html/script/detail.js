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
        el("p", { class: "facts" }, outcomeMark(episode.outcome), el("b", {}, capital(OUTCOMES[episode.outcome].words)), episodeFacts(episode, task).map((words) => el("span", {}, words))),
      ),
      this.stage.root,
      this.now,
      this.line.root,
      el("p", { class: "hint why" }, episode.outcome === "success" ? null : el("b", {}, `${capital(OUTCOMES[episode.outcome].words)}. ${OUTCOMES[episode.outcome].why}`), markLegend()),
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
      .map(([run, episode]) => el("a", { href: address({ run: run.name, ep: episode.id }) }, outcomeMark(episode.outcome), run.name));
    this.others.replaceChildren(...(links.length ? ["Same episode in ", ...links] : []));
  },

  clear() {
    this.stage?.stop();
    this.episode = null;
    byId("detail").replaceChildren(el("p", { class: "hint empty" }, "No episode is selected."));
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
    const now = situation(this.episode, this.frame);
    const operation = now.phase !== "prompt" && now.checkpoint !== null ? this.episode.checkpoints[now.checkpoint][0] : null;
    const key = `${now.phase} ${now.checkpoint}`;
    if (this.now.dataset.key === key) return;
    this.now.dataset.key = key;
    this.now.className = `now ${now.phase}`;
    this.now.replaceChildren(
      operation ? badge(operation) : "",
      el("span", {}, el("span", { class: "quiet" }, this.when(now)), subgoalWords(this.episode, now, this.level)),
    );
  },

  when({ phase, checkpoint }) {
    if (phase === "prompt") return "";
    if (phase === "execution") return "Now: ";
    return checkpoint === null ? "At the end: " : "Still open at the end: ";
  },
};

function episodeFacts(episode, task) {
  const words = [`episode ${episode.episode}`, episode.seed === null ? null : `seed ${episode.seed}`, task.memory_type];
  if (episode.referent !== "fixed") words.push(`${episode.referent} referent, variant ${episode.variant}`);
  words.push(plural(episode.steps, "step"), episode.scene ? `scene ${episode.scene.slice(0, 8)}` : null);
  return words.filter(Boolean);
}

/** The video with its buttons, or a plain word where there is none. `moved` is told the frame that is seen. */
function stage(episode, moved) {
  if (!episode.video) {
    const word = el("p", { role: "status" }, "There is no video of this episode.");
    return {
      root: el("div", { class: "stage absent" }, word, el("p", { class: "hint" }, "The timeline below is from the log. Evaluate with env.videos=true to film every episode.")),
      seek: () => word.classList.add("asked"),
      toggle: () => word.classList.add("asked"),
      stop: () => {},
    };
  }
  const video = el("video", { preload: "auto", playsinline: true, "aria-label": `Video of episode ${episode.episode}` });
  video.muted = true;
  const play = el("button", { type: "button", class: "play", "aria-label": "Play" }, "▶");
  const speed = el("select", { "aria-label": "Speed" }, [0.5, 1, 2, 4].map((rate) => el("option", { value: rate }, `${rate}×`)));
  const error = el("p", { class: "notice", hidden: true });
  const root = el("div", { class: "stage" }, el("div", { class: "screen" }, video), error, el("div", { class: "buttons" }, play, speed, el("span", { class: "hint" }, "Space plays, ← → step, [ ] jump between checkpoints")));

  // Half a frame on, so that rounding cannot fall into the frame before.
  const seen = () => Math.floor(video.currentTime * DATA.fps + 1e-3);
  const follow = () => {
    if (!root.isConnected) return video.pause();
    moved(seen());
    if (!video.paused && !video.ended) requestAnimationFrame(follow);
  };
  const toggle = () => (video.paused ? video.play().catch(() => {}) : video.pause());
  const label = () => {
    play.textContent = video.paused ? "▶" : "❚❚";
    play.setAttribute("aria-label", video.paused ? "Play" : "Pause");
  };
  video.addEventListener("play", () => (label(), follow()));
  video.addEventListener("pause", label);
  video.addEventListener("ended", label);
  video.addEventListener("seeked", () => root.isConnected && moved(seen()));
  video.addEventListener("click", toggle);
  video.addEventListener("error", () => {
    error.hidden = false;
    error.textContent = `This browser cannot play ${episode.video} (H.264 in MP4): ${video.error?.message || "the file is missing or not supported"}.`;
  });
  play.addEventListener("click", toggle);
  speed.value = String(stage.speed ?? 1);
  const setSpeed = () => {
    stage.speed = Number(speed.value);
    video.defaultPlaybackRate = video.playbackRate = stage.speed;
  };
  speed.addEventListener("change", setSpeed);
  setSpeed();
  video.src = episode.video.split("/").map(encodeURIComponent).join("/");
  const seek = (frame) => (video.currentTime = (frame + 0.5) / DATA.fps);
  return { root, seek, toggle, stop: () => video.pause() };
}

const markLegend = () =>
  el("span", { class: "signs" }, [["hollow", "first held"], ["full", "held in order"]].map(([fill, words]) => el("span", {}, shape("S", fill), ` ${words}`)), el("span", {}, el("span", { class: "sample active op-S" }), " being worked on"), el("span", {}, el("span", { class: "sample open op-S" }), " never completed"));

/** The task in this run: its checkpoints with texts, and how many rollouts got that far. */
function taskPanel(run, episode, level) {
  const numbers = run.tasks[episode.task];
  const goal = DATA.tasks[episode.task].variants[episode.variant]?.goal;
  const bar = (rate, operation, kind) =>
    el(
      "td",
      { class: "prefix" },
      el("span", { class: `bar op-${operation} ${kind}`, "aria-hidden": "true" }, el("span", { style: { width: `${rate[0]}%` } })),
      el("span", { class: "number", "data-tip": `95 % interval ${rate[1].toFixed(1)} to ${rate[2].toFixed(1)}, n = ${rate[3]}` }, rate[0].toFixed(1)),
    );
  const rows = [...numbers.operations].map((operation, k) =>
    el(
      "tr",
      {},
      el("td", {}, badge(operation)),
      el("th", { scope: "row", "data-tip": DATA.tasks[episode.task].variants[episode.variant]?.checkpoints[k]?.goal }, checkpointText(episode.task, episode.variant, k, level)),
      bar(numbers.ordered_prefix[k], operation, "full"),
      bar(numbers.prefix[k], operation, "hollow"),
    ),
  );
  const head = rateHead(el("th", { scope: "col", class: "number" }, "n"));
  head.append(el("th", { scope: "col", class: "ends" }, "Outcomes"));
  return el(
    "section",
    { class: "panel" },
    el("h3", {}, `This task in ${run.name}`),
    el("div", { class: "scroll" }, el("table", { class: "rates" }, el("thead", {}, head), el("tbody", {}, el("tr", {}, el("td", { class: "number" }, String(numbers.rates.SR[3])), rateCells(numbers.rates), el("td", {}, outcomeBar(numbers.outcomes, { task: episode.task })))))),
    el(
      "table",
      { class: "checkpoints" },
      el("thead", {}, el("tr", {}, el("th", { scope: "col", colspan: "2" }, "Checkpoint"), el("th", { scope: "col" }, "in order, %"), el("th", { scope: "col" }, "any order, %"))),
      el("tbody", {}, rows),
    ),
    el("p", { class: "hint" }, "Rollouts that completed a checkpoint and all before it."),
    goal ? el("p", { class: "goal" }, el("span", { class: "quiet" }, "Goal "), el("code", {}, goal)) : null,
  );
}
