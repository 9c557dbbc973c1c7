// The same episode of two runs, side by side. Both videos follow one clock, in frames, that begins with the longer
// prompt: executions begin together, and the shorter rollout rests on its last frame.

const AHEAD = 3; // frames that the clock may be ahead of a video which cannot keep up
const APART = 10; // frames off the clock at which a video is put right at once

const pair = {
  sides: [],
  frame: 0,
  end: 0,
  started: null,

  draw(runs, episodes, chosen) {
    const same = this.sides.length && episodes.every((episode, k) => this.sides[k].episode === episode);
    if (same && this.level === chosen.level) return;
    const frame = same ? Math.round(this.frame) : 0;
    this.stop();
    this.level = chosen.level;
    const lead = Math.max(...episodes.map((episode) => episode.prompt));
    this.end = Math.max(...episodes.map((episode) => lead - episode.prompt + lastFrame(episode)));
    this.sides = episodes.map((episode, k) => this.side(runs[k], episode, lead - episode.prompt));
    this.buttons = playButtons(
      () => this.toggle(),
      (rate) => (this.rate = rate),
    );
    this.slider = el("input", { type: "range", min: 0, max: this.end, step: 1, "aria-label": "Time of both" });
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    this.clock = el("span", { class: "clock" });
    const task = DATA.tasks[episodes[0].task];
    byId("detail").replaceChildren(
      el(
        "header",
        {},
        el("h2", {}, taskTitle(episodes[0].task)),
        el(
          "p",
          { class: "facts" },
          episodeFacts(episodes[0], task, { length: false }).map((words) => el("span", {}, words)),
        ),
      ),
      el(
        "div",
        { class: "pair" },
        this.sides.map((side) => side.root),
      ),
      el("div", { class: "both" }, this.buttons.play, this.slider, this.clock, this.buttons.speed),
      el("p", { class: "hint why" }, keysHint(), markLegend()),
    );
    this.seek(frame);
  },

  /** One of the two: its outcome, its video and its timeline. */
  side(run, episode, lead) {
    const screen = episode.video ? screenOf(episode) : { root: emptyStage().root };
    const seek = (frame) => this.seek(frame + lead);
    const now = el("p", { class: "now", "data-run": run.name });
    const line = timeline(episode, this.level, seek, this.end, lead);
    const root = el(
      "section",
      { "aria-label": run.name },
      el("h3", {}, outcomeMark(episode.outcome), el("a", { href: address({ view: "episodes", run: run.name }) }, run.name)),
      el("p", { class: "hint" }, `${capital(OUTCOMES[episode.outcome].words)} after ${plural(episode.steps, "step")}`),
      screen.root,
      screen.error,
      now,
      line.root,
    );
    screen.video?.addEventListener("click", () => this.toggle());
    return { episode, lead, line, now, root, video: screen.video };
  },

  /** The frame of a side at the clock's present, held at both ends. */
  frameOf: (side, frame) => Math.min(Math.max(frame - side.lead, 0), lastFrame(side.episode)),

  get films() {
    return this.sides.filter((side) => side.video && !side.video.error);
  },

  seek(frame) {
    this.frame = Math.min(Math.max(frame, 0), this.end);
    for (const side of this.films) side.video.currentTime = timeOf(this.frameOf(side, this.frame));
    this.show();
  },

  toggle() {
    if (this.started !== null) return this.stop();
    if (!this.films.length) return;
    if (this.frame >= this.end) this.seek(0);
    this.started = performance.now();
    this.buttons.label(false);
    requestAnimationFrame((time) => this.follow(time));
  },

  /** Rest: both videos on exactly the clock's frame. */
  stop() {
    if (this.started === null) return;
    this.started = null;
    for (const side of this.films) side.video.pause();
    this.buttons.label(true);
    this.seek(Math.round(this.frame));
  },

  /** Move the clock on, not further than the slower video can follow, and bring both videos to it. */
  follow(time) {
    if (this.started === null) return;
    if (!byId("detail").contains(this.slider)) return this.stop();
    const passed = Math.max(0, time - this.started) / 1000;
    this.started = Math.max(time, this.started);
    let next = Math.min(this.frame + passed * this.rate * DATA.fps, this.end);
    for (const side of this.films.filter((it) => !it.video.paused && !it.video.ended))
      next = Math.min(next, Math.max(this.frame, side.video.currentTime * DATA.fps - 0.5 + side.lead + AHEAD));
    this.frame = next;
    for (const side of this.films) this.pace(side);
    this.show();
    if (this.frame >= this.end) return this.stop();
    requestAnimationFrame((now) => this.follow(now));
  },

  pace({ video, lead, episode }) {
    const wanted = this.frame - lead;
    if (wanted <= 0 || wanted >= lastFrame(episode)) {
      if (!video.paused) video.pause();
      const held = timeOf(wanted <= 0 ? 0 : lastFrame(episode));
      if (!video.seeking && Math.abs(video.currentTime - held) > 0.5 / DATA.fps) video.currentTime = held;
      return;
    }
    if (video.paused) video.play().catch(() => {});
    if (video.seeking) return;
    const ahead = video.currentTime * DATA.fps - 0.5 - wanted;
    if (Math.abs(ahead) > APART) video.currentTime = timeOf(wanted);
    else video.playbackRate = this.rate * Math.min(Math.max(1 - 0.05 * ahead, 0.7), 1.3);
  },

  /** Jump to the next checkpoint's mark of either side. */
  jump(direction) {
    const marks = this.sides.flatMap(({ lead, root }) =>
      [...root.querySelectorAll(".mark")].map((mark) => Number(mark.dataset.frame) + lead),
    );
    const ahead = marks.filter((frame) => (frame - this.frame) * direction > 0);
    if (ahead.length) this.seek(direction > 0 ? Math.min(...ahead) : Math.max(...ahead));
  },

  show() {
    const frame = Math.round(this.frame);
    this.slider.value = String(frame);
    this.slider.setAttribute("aria-valuetext", seconds(frame));
    this.clock.textContent = `${seconds(frame)} of ${seconds(this.end)}`;
    for (const side of this.sides) {
      const own = this.frameOf(side, frame);
      side.line.show(own);
      showSubgoal(side.now, side.episode, own, this.level);
    }
  },

  clear() {
    this.stop();
    this.sides = [];
  },
};
