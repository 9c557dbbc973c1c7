// The list of rollouts found. Rows are added as the reader gets near them, so thousands cost no more than a screenful.

const CHUNK = 60;

/** The checkpoints of a rollout in one glance: full = in order, hollow = held but not in order, dash = never. */
function checkpointMarks(episode) {
  return el(
    "span",
    { class: "marks", "aria-hidden": "true" },
    episode.checkpoints.map(([operation, first, ordered]) =>
      shape(operation, ordered !== null ? "full" : first !== null ? "hollow" : "none"),
    ),
  );
}

/** A row of the list; `partner` is the same episode of the second run. */
function listRow(episode, partner) {
  return el(
    "li",
    {},
    el(
      "a",
      { class: "row", "data-id": episode.id, href: address({ ep: episode.id }) },
      outcomeMark(episode.outcome),
      partner ? outcomeMark(partner.outcome) : null,
      el(
        "span",
        { class: "name" },
        `Episode ${episode.episode}${episode.referent === "fixed" ? "" : ` · ${episode.referent}`}`,
      ),
      partner ? null : checkpointMarks(episode),
      partner ? null : el("span", { class: "length" }, seconds(episode.prompt + episode.steps)),
      partner || episode.video ? null : el("span", { class: "visually-hidden" }, "no video"),
    ),
  );
}

const list = {
  episodes: [],
  shown: 0,
  watcher: null,
  current: null,

  /** Show these rollouts from the top; `partners` (by id) are their second rollouts. */
  fill(episodes, partners = null) {
    this.episodes = episodes;
    this.partners = partners;
    this.shown = 0;
    this.task = null;
    this.end = el("div", { class: "end", "aria-hidden": "true" });
    byId("list").replaceChildren(this.end);
    byId("list").scrollTop = 0;
    this.watcher?.disconnect();
    this.watcher = new IntersectionObserver((entries) => entries.some((entry) => entry.isIntersecting) && this.more(), {
      root: byId("list"),
      rootMargin: "600px",
    });
    this.more();
    if (!episodes.length) this.end.before(el("p", { class: "hint" }, "No episode matches these filters."));
  },

  /** Add the next rows; watched anew, the end tells again when it is still in sight. */
  more(count = CHUNK) {
    this.watcher.unobserve(this.end);
    for (const episode of this.episodes.slice(this.shown, this.shown + count)) {
      if (episode.task !== this.task) {
        this.task = episode.task;
        this.end.before(el("h3", {}, taskTitle(episode.task)), (this.group = el("ol")));
      }
      this.group.append(listRow(episode, this.partners?.get(episode.id)));
    }
    this.shown = Math.min(this.shown + count, this.episodes.length);
    if (this.shown < this.episodes.length) this.watcher.observe(this.end);
  },

  /** Mark the selected row, adding rows up to it. */
  mark(id) {
    this.current = id;
    const place = this.episodes.findIndex((episode) => episode.id === id);
    if (place >= this.shown) this.more(place - this.shown + CHUNK);
    for (const row of byId("list").querySelectorAll("[aria-current]")) row.removeAttribute("aria-current");
    const row = byId("list").querySelector(`[data-id="${CSS.escape(id)}"]`);
    row?.setAttribute("aria-current", "true");
    row?.scrollIntoView({ block: "nearest" });
  },

  /** Select the rollout that stands `distance` further down. */
  move(distance) {
    if (!this.episodes.length) return;
    const place = this.episodes.findIndex((episode) => episode.id === this.current);
    const next = Math.min(Math.max(place + distance, 0), this.episodes.length - 1);
    const view = selection().view === "compare" ? "compare" : "episodes";
    select({ view, ep: this.episodes[next].id });
  },
};
