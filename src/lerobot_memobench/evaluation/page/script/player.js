// The video of a rollout. Frame k is on the screen from k / fps to (k + 1) / fps.

/** The video of a rollout, and a sentence where this browser cannot play it. */
function screenOf(episode) {
  const video = el("video", {
    preload: "auto",
    playsinline: true,
    "aria-label": `Video of episode ${episode.episode}`,
  });
  video.muted = true;
  const error = el("p", { class: "notice", hidden: true });
  video.addEventListener("error", () => {
    const reason = video.error?.message || "the file is missing or not supported";
    error.hidden = false;
    error.textContent = `This browser cannot play ${episode.video} (H.264 in MP4): ${reason}.`;
  });
  video.src = episode.video.split("/").map(encodeURIComponent).join("/");
  return { video, error, root: el("div", { class: "screen" }, video) };
}

// Into the middle of the frame, so that rounding cannot show the one before.
const timeOf = (frame) => (frame + 0.5) / DATA.fps;

/** The buttons of a player: `toggle` plays or pauses, `paced` is told the speed, now and when it is chosen. */
function playButtons(toggle, paced) {
  const play = el("button", { type: "button", class: "play", "aria-label": "Play", on: { click: toggle } }, "▶");
  const rates = [0.5, 1, 2, 4].map((rate) => el("option", { value: rate }, `${rate}×`));
  const speed = el("select", { "aria-label": "Speed" }, rates);
  const pace = () => paced((playButtons.speed = Number(speed.value)));
  speed.value = String(playButtons.speed ?? 1);
  speed.addEventListener("change", pace);
  pace();
  const label = (paused) => {
    play.textContent = paused ? "▶" : "❚❚";
    play.setAttribute("aria-label", paused ? "Play" : "Pause");
  };
  return { play, speed, label };
}

const keysHint = () => el("span", { class: "hint" }, `Space plays, ← → step${DATA.suite ? "" : ", [ ] jump between checkpoints"}`);

/** The video with its buttons, or a plain word where there is none. `moved` is told the frame that is seen. */
function stage(episode, moved) {
  if (!episode.video) return emptyStage();
  const { video, error, root: screen } = screenOf(episode);
  const toggle = () => (video.paused ? video.play().catch(() => {}) : video.pause());
  const { play, speed, label } = playButtons(toggle, (rate) => (video.defaultPlaybackRate = video.playbackRate = rate));
  const root = el("div", { class: "stage" }, screen, error, el("div", { class: "buttons" }, play, speed, keysHint()));

  const seen = () => Math.floor(video.currentTime * DATA.fps + 1e-3);
  const follow = () => {
    if (!root.isConnected) return video.pause();
    moved(seen());
    if (!video.paused && !video.ended) requestAnimationFrame(follow);
  };
  video.addEventListener("play", () => (label(false), follow()));
  video.addEventListener("pause", () => label(true));
  video.addEventListener("ended", () => label(true));
  video.addEventListener("seeked", () => root.isConnected && moved(seen()));
  video.addEventListener("click", toggle);
  const seek = (frame) => (video.currentTime = timeOf(frame));
  return { root, seek, toggle, stop: () => video.pause() };
}

function emptyStage() {
  const word = el("p", { role: "status" }, "There is no video of this episode.");
  const hint = "The timeline below is from the log. Evaluate with videos=-1 to record every episode.";
  const ask = () => word.classList.add("asked");
  return {
    root: el("div", { class: "stage absent" }, word, el("p", { class: "hint" }, hint)),
    seek: ask,
    toggle: ask,
    stop: () => {},
  };
}
